// Stage: the scene of the chosen job in the player, and a held-out photograph beside it.

import { Player } from "/web/player/player.js";
import { Renderer } from "/web/player/renderer.js";
import { Comparison } from "./comparison.js";
import { may, request } from "./requests.js";

const RELOAD_MS = 20_000; // while a job trains: the service needs seconds of a core for each scene file

export class Stage {
  /** @param {HTMLElement} root */
  constructor(root) {
    this.job = null;
    this.shown = null; // address of the scene that is loaded or being loaded
    this.loaded = 0;
    this.loading = false;
    this.player = new Player(root, {
      worker: "/web/player/sort_worker.js",
      link: (state) => `${location.origin}/#job=${this.job.id}&${state}`,
      settled: () => history.replaceState(null, "", `#job=${this.job.id}&${this.player.state}`),
    });
    this.comparison = new Comparison();
    this.drawing = Renderer.isSupported();
  }

  /**
   * Show a job; also called whenever something of it has changed.
   * @param {any} job
   * @param {string} state of the player to restore
   */
  async show(job, state = "") {
    const other = this.job?.id !== job?.id;
    const before = this.job;
    this.job = job;
    if (other || !job) {
      this.shown = null;
      this.player.clear(job ? "" : "No model yet. Upload a capture, try a scene, or run graings demo.");
      this.comparison.show(null);
    }
    if (!job) return;
    const address = job.links.scene;
    if (!address) {
      const waits = job.state === "queued" || job.state === "running";
      this.player.say(waits ? "The first checkpoint is not written yet." : "This job ended before its first checkpoint.");
      return;
    }
    if (!this.shown) {
      this.shown = address;
      const facts = await request(job.links.views);
      if (this.job?.id !== job.id) return;
      this.player.say("");
      this.player.open(facts, job.links.render);
      if (state) this.player.state = state;
      this.load(address);
      this.compare(facts);
    } else if (address !== this.shown && !this.loading && (job.state !== "running" || Date.now() - this.loaded > RELOAD_MS)) {
      this.load(address);
    }
    if (before && before.checkpoint !== job.checkpoint) {
      this.comparison.refresh();
      if (!this.drawing) this.player.change();
    }
  }

  compare(facts) {
    if (!may("read")) return;
    const names = facts.cameras.map((camera) => camera.name);
    const held = names.filter((name) => !name.startsWith("train:"));
    this.comparison.show(this.job, held.length ? held : names);
  }

  async load(address) {
    this.shown = address;
    if (!this.drawing) {
      this.player.say("This browser has no WebGL2: the service draws every picture.");
      return;
    }
    const { job } = this;
    this.loading = true;
    try {
      await this.player.load(address);
    } catch (error) {
      if (this.job?.id === job.id) this.player.say(error.message);
    }
    this.loading = false;
    this.loaded = Date.now();
  }
}
