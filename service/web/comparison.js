// Comparison: a held-out photograph, the model from its camera, and their difference.

import { refusal } from "/web/player/scene_file.js";
import { element } from "./format.js";

const $ = (id) => document.getElementById(id);
const PARTS = ["Photograph", "Model", "Difference, 5 times"];

export class Comparison {
  constructor() {
    this.job = null;
    this.number = 0;
    this.canvases = PARTS.map((name) => element("canvas", { role: "img", "aria-label": name, width: 1, height: 1 }));
    const figures = PARTS.map((name, i) => {
      const figure = element("figure");
      figure.append(this.canvases[i], element("figcaption", {}, name));
      return figure;
    });
    $("pictures").replaceChildren(...figures);
    $("held").onchange = () => this.refresh();
    $("comparison").ontoggle = () => this.refresh();
  }

  /**
   * @param {any} job none: hide
   * @param {string[]} cameras that there are photographs of
   */
  show(job, cameras = []) {
    this.job = job;
    this.number++;
    $("comparison").hidden = !job;
    $("quality").textContent = "";
    if (!job) return;
    $("held").replaceChildren(...cameras.map((name) => element("option", {}, name)));
    $("comparison").open = job.state === "running";
    this.refresh();
  }

  async refresh() {
    if (!this.job || !$("comparison").open) return;
    const number = ++this.number;
    try {
      const response = await fetch(`${this.job.links.comparison}?camera=${$("held").value}`);
      if (!response.ok) throw await refusal(response);
      const picture = await createImageBitmap(await response.blob());
      if (number !== this.number) return;
      const width = picture.width / PARTS.length;
      this.canvases.forEach((canvas, i) => {
        canvas.width = width;
        canvas.height = picture.height;
        canvas.getContext("2d").drawImage(picture, -i * width, 0);
      });
      const [psnr, iteration] = ["PSNR", "Iteration"].map((name) => response.headers.get(`X-Graings-${name}`));
      $("quality").textContent = `${psnr} dB after ${iteration} iterations`;
    } catch (error) {
      if (number === this.number) $("quality").textContent = error.message;
    }
  }
}
