// Stage: the scene of the chosen job in the player, and a held-out photograph beside it.

import { Player } from "/web/player/player.js";
import { Renderer } from "/web/player/renderer.js";
import { Comparison } from "./comparison.js";
import { may, request } from "./requests.js";

// While a job trains, or after a scene could not be loaded: the service needs seconds of a core for each scene file.
const RELOAD_MS = 20_000;

export class Stage {
  /** @param {HTMLElement} root */
  constructor(root) {
    this.job = null;
    this.opened = false; // whether the cameras of the job are known or being asked for
    this.shown = null; // address of the scene that is loaded or being loaded
    this.loaded = 0;
    this.loading = false;
    this.loads = 0; // how many were begun
    this.failed = false; // whether the last scene could not be loaded
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
      this.opened = this.failed = false;
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
    const seldom = job.state === "running" || this.failed;
    if (!this.opened) {
      await this.open(job, address, state);
    } else if (address !== this.shown && !this.loading && (!seldom || Date.now() - this.loaded > RELOAD_MS)) {
      this.load(address);
    }
    if (before && before.checkpoint !== job.checkpoint) {
      this.comparison.refresh();
      if (!this.drawing) this.player.change();
    }
  }

  async open(job, address, state) {
    this.opened = true;
    this.shown = address;
    let facts;
    try {
      facts = await request(job.links.views);
    } catch (error) {
      if (this.job?.id !== job.id) return;
      this.opened = false; // the next refresh of the page asks again
      this.shown = null;
      this.player.say(error.message);
      return;
    }
    if (this.job?.id !== job.id) return;
    this.player.say("");
    this.player.open(facts, job.links.render);
    if (state) this.player.state = state;
    this.load(address);
    this.compare(facts);
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
    const number = ++this.loads;
    this.loading = true;
    const error = await this.player.load(address).then(() => null, (refused) => refused);
    if (number !== this.loads) return; // another scene is being loaded
    this.loading = false;
    this.loaded = Date.now();
    if (this.job?.id !== job.id) return;
    if (error || this.failed) this.player.say(error?.message ?? "");
    this.failed = error !== null;
    if (error) this.shown = null; // it is asked for again
  }
}
