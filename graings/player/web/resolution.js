// Resolution: the share of all pixels along each axis that moving pictures have, so that they keep up with the hand.

const [QUICK_MS, SLOW_MS] = [25, 60];
const LEAST = 0.25;

export class Resolution {
  constructor() {
    this.scale = 1;
  }

  /** What a picture in full resolution has taken. */
  begin(milliseconds) {
    this.scale = Math.min(1, Math.max(LEAST, Math.sqrt(SLOW_MS / milliseconds)));
  }

  /** What the last frame has taken. */
  adapt(milliseconds) {
    if (milliseconds > SLOW_MS) this.scale = Math.max(LEAST, this.scale * 0.8);
    else if (milliseconds < QUICK_MS) this.scale = Math.min(1, this.scale * 1.02);
  }
}
