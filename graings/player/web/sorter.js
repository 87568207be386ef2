// Sorter: asks the worker for one order at a time, and then for that of the newest view.

import { functionsAt } from "./scene_file.js";

export class Sorter {
  /**
   * @param {import("./scene_file.js").Scene} scene
   * @param {string} address of sort_worker.js
   * @param {(order: Uint32Array) => void} receive gets each order
   */
  constructor(scene, address, receive) {
    this.scene = scene;
    this.receive = receive;
    this.busy = false;
    this.wanted = null;
    this.functions = new Float32Array(scene.geometry.rank * scene.geometry.values);
    this.worker = new Worker(address);
    const { count, means, geometry, header } = scene;
    const { rank, rows, weights } = geometry;
    this.worker.postMessage({ scene: { count, means, rows, rank, weights, near: header.raster.near } });
    this.worker.onmessage = ({ data }) => {
      this.busy = false;
      this.receive(data.order);
      if (this.wanted) this.sort(...this.wanted);
    };
  }

  /**
   * @param {import("./camera.js").Camera} camera
   * @param {number} time
   */
  sort(camera, time) {
    if (this.busy) {
      this.wanted = [camera, time];
      return;
    }
    this.wanted = null;
    this.busy = true;
    functionsAt(this.scene.geometry, time, this.functions);
    this.worker.postMessage({ forward: camera.rotation.slice(6, 9), center: camera.center, functions: this.functions });
  }

  close() {
    this.worker.terminate();
  }
}
