// Pictures: the server's exact pictures, one request at a time, then that of the newest view.

import { renderQuery } from "./camera.js";
import { refusal } from "./scene_file.js";

/** RGB in [0, 1] of #rrggbb. */
export const rgb = (text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16) / 255);

export class Pictures {
  /**
   * @param {string} address of /render, with its job
   * @param {HTMLImageElement} image
   * @param {(error: Error | null) => void} report the failure of a request, or that one has succeeded
   */
  constructor(address, image, report) {
    this.address = address;
    this.image = image;
    this.report = report;
    this.busy = false;
    this.failed = false;
    this.wanted = null;
    this.number = 0;
    this.alone = true; // whether nothing else is shown: then a picture of an earlier view is better than none
  }

  /**
   * Show the picture of a camera as soon as there is one.
   * @param {import("./camera.js").Camera} camera
   * @param {number} time
   * @param {number[]} background
   * @param {any} units
   */
  show(camera, time, background, units) {
    const query = new URLSearchParams({ ...renderQuery(camera, units), t: time, background: background.join(","), format: "webp" });
    this.wanted = `${this.address}&${query}`;
    this.number++;
    if (!this.busy) this.run();
  }

  /** Show none, whatever is under way. */
  hide() {
    this.wanted = null;
    this.number++;
    this.image.classList.remove("shown");
  }

  /** Show none and report nothing from now on, whatever is under way: the image and the messages are another's. */
  close() {
    this.alone = false;
    this.report = () => {};
    this.hide();
  }

  async run() {
    this.busy = true;
    while (this.wanted !== null) {
      const [address, number] = [this.wanted, this.number];
      this.wanted = null;
      try {
        const response = await fetch(address);
        if (!response.ok) throw await refusal(response);
        const made = URL.createObjectURL(await response.blob());
        if (number !== this.number && !this.alone) {
          URL.revokeObjectURL(made);
          continue;
        }
        const old = this.image.src;
        this.image.src = made;
        await this.image.decode();
        if (old) URL.revokeObjectURL(old);
        if (number === this.number || this.alone) this.image.classList.add("shown");
        if (this.failed) this.report(null);
        this.failed = false;
      } catch (error) {
        this.failed = true;
        this.report(error);
        await new Promise((resolve) => setTimeout(resolve, 1000));
      }
    }
    this.busy = false;
  }
}
