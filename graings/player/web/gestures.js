// Gestures: mouse, touch and keys on the stage, as changes of the viewpoint and calls of actions.

const KEY_ANGLE = (5 / 180) * Math.PI;
const KEY_PAN = 0.05; // of the stage's width
const TURN = Math.PI; // radians for a drag over the whole width

/**
 * @typedef {object} Hand
 * @property {(yaw: number, pitch: number) => void} orbit radians
 * @property {(x: number, y: number) => void} pan px of the page
 * @property {(factor: number) => void} zoom
 * @property {(held: boolean) => void} hold a hand is on the stage, or no longer
 * @property {() => void} reset
 * @property {Object<string, () => void>} keys actions by key
 */

/**
 * Connect a stage with what its gestures do.
 * @param {HTMLElement} stage
 * @param {Hand} hand
 */
export function listen(stage, hand) {
  /** @type {Map<number, {x: number, y: number}>} */
  const fingers = new Map();
  const spread = () => {
    const [a, b] = [...fingers.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, distance: Math.hypot(a.x - b.x, a.y - b.y) };
  };

  stage.addEventListener("pointerdown", (event) => {
    if (event.target.closest("button, a, input, select")) return;
    stage.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    hand.hold(true);
  });
  stage.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY };
    if (fingers.size >= 2) {
      const old = spread();
      fingers.set(event.pointerId, now);
      const next = spread();
      hand.pan(next.x - old.x, next.y - old.y);
      if (next.distance > 0) hand.zoom(old.distance / next.distance);
      return;
    }
    fingers.set(event.pointerId, now);
    const [x, y] = [now.x - before.x, now.y - before.y];
    if (event.shiftKey || event.buttons > 1) hand.pan(x, y);
    else hand.orbit((-x / stage.clientWidth) * TURN, (y / stage.clientWidth) * TURN);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    stage.addEventListener(name, (event) => {
      if (fingers.delete(event.pointerId) && fingers.size === 0) hand.hold(false);
    });
  }
  stage.addEventListener("contextmenu", (event) => event.preventDefault());
  stage.addEventListener("dblclick", hand.reset);
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    hand.zoom(Math.exp(event.deltaY * (event.deltaMode ? 0.05 : 0.001)));
  }, { passive: false });

  const moves = {
    ArrowLeft: [1, 0],
    ArrowRight: [-1, 0],
    ArrowUp: [0, 1],
    ArrowDown: [0, -1],
  };
  stage.addEventListener("keydown", (event) => {
    if (event.target !== stage || event.ctrlKey || event.altKey || event.metaKey) return;
    const move = moves[event.key];
    const step = KEY_PAN * stage.clientWidth;
    if (move && event.shiftKey) hand.pan(move[0] * step, move[1] * step);
    else if (move) hand.orbit(-move[0] * KEY_ANGLE, move[1] * KEY_ANGLE);
    else if (event.key === "+" || event.key === "=") hand.zoom(0.9);
    else if (event.key === "-") hand.zoom(1 / 0.9);
    else if (hand.keys[event.key]) hand.keys[event.key]();
    else return;
    event.preventDefault();
  });
}
