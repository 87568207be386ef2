// Reading a scene file; docs/player.md has its layout.

/**
 * Functions of time and how much each Gaussian has of them: offset_i(t) = sum_r weights[r][i] functions(t)[r].
 * @typedef {object} Basis
 * @property {number} rank
 * @property {number} rows how many of the first Gaussians have weights
 * @property {number} values numbers of which an offset consists
 * @property {Float32Array} weights rank x rows, one function after the other
 * @property {number} samples
 * @property {Float32Array} functions samples x rank x values, evenly spaced times from 0 to 1
 */

/**
 * @typedef {object} Scene
 * @property {any} header
 * @property {number} count Gaussians
 * @property {Float32Array} means 3 x count: one column after the other, as all tables
 * @property {Float32Array} quats 4 x count: w, x, y, z
 * @property {Float32Array} logScales 3 x count
 * @property {Float32Array} opacities count
 * @property {Float32Array} harmonics 3 K x count: red, green and blue of each harmonic
 * @property {Basis} geometry ten values: position, rotation, log-scale
 * @property {Basis} residual four values: red, green, blue, opacity
 */

const MAGIC = "GRNSCENE";
const SCHEMA = "graings.player_scene/1";

/**
 * The scene in the bytes of a file. Throws where they are not one.
 * @param {ArrayBuffer} packed
 * @returns {Promise<Scene>}
 */
export async function readScene(packed) {
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const plain = await new Response(stream).arrayBuffer();
  const bytes = new Uint8Array(plain);
  if (new TextDecoder().decode(bytes.subarray(0, 8)) !== MAGIC) throw new Error("This is not a scene file.");
  const length = new DataView(plain).getUint32(8, true);
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(12, 12 + length)));
  if (header.schema !== SCHEMA) throw new Error(`This player reads ${SCHEMA}, and the file is ${header.schema}.`);
  const body = bytes.subarray(12 + length);
  const tables = Object.fromEntries(header.tables.map((table) => [table.name, table]));
  const values = (name) => unpack(tables[name], body);
  return {
    header,
    count: header.children,
    means: values("means"),
    quats: values("quats"),
    logScales: values("log_scales"),
    opacities: values("opacities"),
    harmonics: values("harmonics"),
    geometry: basis(tables, values, "geometry", 10),
    residual: basis(tables, values, "residual", 4),
  };
}

/** A basis; its functions are stored one column after the other and are read one sample after the other. */
function basis(tables, values, name, width) {
  const { rows: samples, columns } = tables[`${name}_functions`];
  const columnwise = values(`${name}_functions`);
  const functions = new Float32Array(samples * columns);
  for (let column = 0; column < columns; column++) {
    for (let sample = 0; sample < samples; sample++) functions[sample * columns + column] = columnwise[column * samples + sample];
  }
  const { rows, columns: rank } = tables[`${name}_weights`];
  return { rank, rows, values: width, weights: values(`${name}_weights`), samples, functions };
}

/** The values of a table, one column after the other: offset + step q, with q from its planes of bytes. */
function unpack({ rows, columns, planes, delta, start, offsets, steps }, body) {
  const size = rows * columns;
  const values = new Float32Array(size);
  const plane = (number) => (number < planes ? body.subarray(start + number * size, start + (number + 1) * size) : null);
  const [low, middle, high] = [plane(0), plane(1), plane(2)];
  for (let column = 0; column < columns; column++) {
    const offset = offsets[column];
    const step = steps[column];
    let before = 0;
    for (let i = column * rows, end = i + rows; i < end; i++) {
      let q = low[i];
      if (middle) q |= middle[i] << 8;
      if (high) q |= high[i] << 16;
      if (delta) before = q = before + ((q >>> 1) ^ -(q & 1));
      values[i] = offset + step * q;
    }
  }
  return values;
}

/**
 * The functions of a basis at a time in [0, 1], linear between samples.
 * @param {Basis} basis
 * @param {number} time
 * @param {Float32Array} target rank x values numbers
 */
export function functionsAt(basis, time, target) {
  const width = basis.rank * basis.values;
  const at = Math.min(1, Math.max(0, time)) * (basis.samples - 1);
  const before = Math.min(Math.floor(at), Math.max(0, basis.samples - 2));
  const after = Math.min(before + 1, basis.samples - 1);
  const part = at - before;
  for (let i = 0; i < width; i++) {
    const one = basis.functions[before * width + i];
    target[i] = one + part * (basis.functions[after * width + i] - one);
  }
}

/** Why a request was refused: what the service says, or the status if a proxy in between answers. */
export async function refusal(response) {
  const problem = await response.json().catch(() => ({}));
  return new Error(problem.detail ?? problem.title ?? `The service answered ${response.status}.`);
}

/**
 * The bytes of a file.
 * @param {string} address
 * @param {(part: number) => void} report gets the share that has come
 */
export async function download(address, report) {
  const response = await fetch(address);
  if (!response.ok) throw await refusal(response);
  const total = Number(response.headers.get("Content-Length"));
  const parts = [];
  let received = 0;
  for (const reader = response.body.getReader(); ; ) {
    const { done, value } = await reader.read();
    if (done) return new Blob(parts).arrayBuffer();
    parts.push(value);
    received += value.length;
    if (total) report(received / total);
  }
}
