// Worker: the Gaussians in front of a camera at a time, from back to front.
//
// A depth is linear in the position, and a position in the functions of time. So the functions are projected on the
// viewing direction once, and each Gaussian needs one product for each function instead of three.

const BINS = 1 << 16;
const counts = new Uint32Array(BINS + 1);

/** @type {{count: number, means: Float32Array, rows: number, rank: number, weights: Float32Array, near: number}} */
let scene;
let depths;
let bits; // of the depths
let keys;

/**
 * Indices by decreasing depth, equal ones in the order of the file.
 * @param {number[]} forward viewing direction
 * @param {number[]} center of the camera
 * @param {Float32Array} functions of the geometry at this time, rank x 10
 * @returns {Uint32Array}
 */
function sorted(forward, center, functions) {
  const { count, means, rows, rank, weights, near } = scene;
  const start = -(forward[0] * center[0] + forward[1] * center[1] + forward[2] * center[2]);
  for (let i = 0; i < count; i++) {
    depths[i] = start + forward[0] * means[i] + forward[1] * means[count + i] + forward[2] * means[2 * count + i];
  }
  for (let r = 0; r < rank; r++) {
    const along = forward[0] * functions[10 * r] + forward[1] * functions[10 * r + 1] + forward[2] * functions[10 * r + 2];
    const column = weights.subarray(r * rows, (r + 1) * rows);
    for (let i = 0; i < rows; i++) depths[i] += along * column[i];
  }
  // The bits of positive floats are ordered as the floats are, and about as their logarithms: a few distant Gaussians
  // do not take all bins.
  let low = Infinity;
  let high = 0;
  for (let i = 0; i < count; i++) {
    if (!(depths[i] > near)) continue;
    if (bits[i] < low) low = bits[i];
    if (bits[i] > high) high = bits[i];
  }
  const scale = (BINS - 1) / Math.max(high - low, 1);
  counts.fill(0);
  let shown = 0;
  for (let i = 0; i < count; i++) {
    if (!(depths[i] > near)) {
      keys[i] = BINS;
      continue;
    }
    const key = BINS - 1 - Math.floor((bits[i] - low) * scale);
    keys[i] = key;
    counts[key + 1]++;
    shown++;
  }
  for (let bin = 0; bin < BINS; bin++) counts[bin + 1] += counts[bin];
  const order = new Uint32Array(shown);
  for (let i = 0; i < count; i++) if (keys[i] < BINS) order[counts[keys[i]]++] = i;
  return order;
}

self.onmessage = ({ data }) => {
  if (data.scene) {
    scene = data.scene;
    depths = new Float32Array(scene.count);
    bits = new Uint32Array(depths.buffer);
    keys = new Uint32Array(scene.count);
    return;
  }
  const order = sorted(data.forward, data.center, data.functions);
  self.postMessage({ order }, [order.buffer]);
};
