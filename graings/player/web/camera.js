// Cameras: OpenCV axes (x right, y down, z forward), lengths in normalised units, as graings.camera.camera has them.

/**
 * @typedef {object} Camera
 * @property {number[]} rotation 9 numbers, rows of the world-to-camera rotation: right, down, forward
 * @property {number[]} center 3 numbers
 * @property {number} fx
 * @property {number} fy
 * @property {number} cx
 * @property {number} cy
 * @property {number} width px
 * @property {number} height px
 */

/**
 * A viewpoint that people can change: a camera looks at `target` from `radius` away. `right`, `down`, `forward` turn.
 * @typedef {object} Viewpoint
 * @property {number[]} target
 * @property {number[]} rotation as of a camera
 * @property {number} radius
 * @property {number} focal focal lengths as a share of the picture's width, and of its height times the aspect ratio
 * @property {number} focalY
 * @property {number[]} shift principal point from the middle, as shares of width and height
 */

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const add = (a, b, factor = 1) => [a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]];
const unit = (a) => a.map((x) => x / Math.hypot(...a));
const axes = (rotation) => [rotation.slice(0, 3), rotation.slice(3, 6), rotation.slice(6, 9)];

/** A vector turned about a unit axis. */
function turned(vector, axis, angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const along = dot(vector, axis) * (1 - c);
  const side = cross(axis, vector);
  return vector.map((x, i) => x * c + side[i] * s + axis[i] * along);
}

/**
 * The camera of a viewpoint for a picture of this size. The picture shows at least the largest rectangle of `aspect`,
 * width over height, in it: that of the view the player begins with, which other views of a capture may not have.
 * @param {Viewpoint} view
 * @param {number} width
 * @param {number} height
 * @param {number} aspect
 * @returns {Camera}
 */
export function cameraOf(view, width, height, aspect) {
  const side = Math.min(width, height * aspect); // the largest rectangle of the capture's shape in the picture
  return {
    rotation: view.rotation,
    center: add(view.target, view.rotation.slice(6, 9), -view.radius),
    fx: view.focal * side,
    fy: view.focalY * side,
    cx: width / 2 + view.shift[0] * side,
    cy: height / 2 + (view.shift[1] * side) / aspect,
    width,
    height,
  };
}

/**
 * The viewpoint of a camera in a scene file; the target is the point of its axis nearest to the middle of the scene.
 * @param {any} facts
 * @returns {Viewpoint}
 */
export function viewpointOf(facts) {
  const rows = facts.world_to_camera;
  const rotation = rows.flatMap((row) => row.slice(0, 3));
  const shift = rows.map((row) => row[3]);
  const center = [0, 1, 2].map((i) => -(rows[0][i] * shift[0] + rows[1][i] * shift[1] + rows[2][i] * shift[2]));
  const forward = rotation.slice(6, 9);
  const radius = Math.max(0.1, -dot(center, forward));
  const [fx, fy, cx, cy] = facts.intrinsics;
  const [width, height] = facts.size;
  return {
    target: add(center, forward, radius),
    rotation,
    radius,
    focal: fx / width,
    focalY: fy / width,
    shift: [cx / width - 0.5, cy / height - 0.5],
  };
}

/**
 * Turned about the scene's vertical axis by `yaw` and about the picture's horizontal one by `pitch`, in radians. The
 * horizon stays level, and the camera stops above and below the target.
 * @param {Viewpoint} view
 * @param {number[]} up
 */
export function orbit(view, up, yaw, pitch) {
  const [right, , forward] = axes(view.rotation);
  const elevation = Math.asin(Math.max(-1, Math.min(1, -dot(forward, up))));
  const limit = (89 / 180) * Math.PI;
  const step = Math.max(-limit, Math.min(limit, elevation + pitch)) - elevation;
  const turn = (axis) => turned(turned(axis, right, -step), up, yaw);
  const ahead = unit(turn(forward));
  const side = unit(add(turn(right), ahead, -dot(turn(right), ahead)));
  return { ...view, rotation: [...side, ...cross(ahead, side), ...ahead] };
}

/** Moved so that the target goes `x` px to the right and `y` down in the picture of `camera`, which sees the view. */
export function pan(view, x, y, camera) {
  const [right, down] = axes(view.rotation);
  const [across, along] = [(x * view.radius) / camera.fx, (y * view.radius) / camera.fy];
  return { ...view, target: add(add(view.target, right, -across), down, -along) };
}

/** Nearer by a factor below 1, farther by one above. */
export function zoom(view, factor) {
  return { ...view, radius: Math.max(0.02, Math.min(100, view.radius * factor)) };
}

/** Sampling rate of a camera over that of the training views, as graings.camera.sampling_rate defines it. */
export function relativeRate(camera, sampling) {
  const { reference, tolerance } = sampling;
  const rate = samplingRate(camera, sampling);
  return rate / Math.min(Math.max(rate, reference / tolerance), reference * tolerance);
}

/** How many times coarser a camera is than what is drawn without supersampling. */
export function undersampling(camera, sampling) {
  return sampling.coarsest / sampling.tolerance / samplingRate(camera, sampling);
}

function samplingRate(camera, sampling) {
  return Math.sqrt(camera.fx * camera.fy) / Math.max(Math.hypot(...camera.center), sampling.extent);
}

/** Parameters of /render for this camera: its pose in the capture's units. */
export function renderQuery(camera, units) {
  const rows = axes(camera.rotation);
  const matrix = rows.map((row) => [...row, -dot(row, camera.center) / units.scale - dot(row, units.center)]);
  const { fx, fy, cx, cy, width, height } = camera;
  return { pose: JSON.stringify([...matrix, [0, 0, 0, 1]]), fx, fy, cx, cy, width, height };
}

/** A viewpoint as text for a link, and back; null if the text is not one. */
export function viewpointText(view) {
  const quat = quaternion(view.rotation);
  return [...view.target, ...quat, view.radius, view.focal, view.focalY, ...view.shift].map((x) => +x.toFixed(5)).join(",");
}

export function viewpointFrom(text) {
  const numbers = text.split(",").map(Number);
  if (numbers.length !== 12 || !numbers.every(Number.isFinite) || !(numbers[7] > 0 && numbers[8] > 0 && numbers[9] > 0)) return null;
  const norm = Math.hypot(...numbers.slice(3, 7));
  if (norm < 0.5) return null;
  const [w, x, y, z] = numbers.slice(3, 7).map((value) => value / norm);
  return {
    target: numbers.slice(0, 3),
    rotation: [
      ...[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      ...[2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      ...[2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ],
    radius: numbers[7],
    focal: numbers[8],
    focalY: numbers[9],
    shift: numbers.slice(10, 12),
  };
}

/** (w, x, y, z) of a rotation, from its largest component. */
function quaternion(m) {
  const squares = [m[0] + m[4] + m[8], m[0] - m[4] - m[8], m[4] - m[0] - m[8], m[8] - m[0] - m[4]];
  const largest = squares.indexOf(Math.max(...squares));
  const s = 2 * Math.sqrt(1 + squares[largest]);
  const sums = [m[7] - m[5], m[2] - m[6], m[3] - m[1]];
  if (largest === 0) return [s / 4, ...sums.map((x) => x / s)];
  const quat = [0, 0, 0, 0];
  const [i, j, k] = [largest - 1, largest % 3, (largest + 1) % 3];
  quat[0] = sums[i] / s;
  quat[1 + i] = s / 4;
  quat[1 + j] = (m[3 * j + i] + m[3 * i + j]) / s;
  quat[1 + k] = (m[3 * k + i] + m[3 * i + k]) / s;
  return quat;
}
