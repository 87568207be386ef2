// Player: a scene that plays and that people can turn, with the server's pictures where and until there is no WebGL2.

import { Bar, element } from "./bar.js";
import { cameraOf, orbit, pan, viewpointOf, zoom } from "./camera.js";
import { listen } from "./gestures.js";
import { copy, stateFrom, stateText } from "./link.js";
import { Pictures, rgb } from "./pictures.js";
import { Renderer } from "./renderer.js";
import { Resolution } from "./resolution.js";
import { download, readScene } from "./scene_file.js";
import { Sorter } from "./sorter.js";

const PLAY_MS = 4000; // from the first to the last time at speed 1
const SETTLE_MS = 300; // without a change, until the server is asked for the exact picture
const DRAFT_SIDE = 256; // of the server's pictures while something changes
const EXACT_SIDE = 1024;

export class Player {
  /**
   * @param {HTMLElement} root gets the stage and the bar
   * @param {object} options
   * @param {string} options.worker address of sort_worker.js
   * @param {(text: string) => string} options.link the address that restores this state
   * @param {() => void} [options.settled] called when the view or the time has been changed
   */
  constructor(root, { worker, link, settled = () => {} }) {
    Object.assign(this, { root, worker, link, settled, facts: null, renderer: null, sorter: null, pictures: null });
    Object.assign(this, { view: null, time: 0, playing: false, looping: true, speed: 1, background: null, held: false });
    Object.assign(this, { dirty: false, stale: false, moving: false, resolution: new Resolution(), frame: 0, before: 0, timer: 0, loads: 0 });
    this.canvas = element("canvas", { "aria-hidden": "true" });
    this.image = element("img", { alt: "", draggable: "false" });
    this.message = element("p", { class: "message", role: "status" });
    this.progress = element("progress", { max: "1", "aria-label": "Loading the scene" });
    this.progress.hidden = true;
    const label = "The scene. Arrows turn it, with shift they move it; plus and minus zoom, space plays, comma and period step, Home resets.";
    this.stage = element("div", { class: "stage", tabindex: "0", role: "application", "aria-label": label }, this.canvas, this.image, this.message, this.progress);
    this.bar = new Bar({
      play: () => this.play(!this.playing),
      seek: (time) => this.seek(time),
      loop: (on) => (this.looping = on),
      speed: (speed) => (this.speed = speed),
      visit: (index) => this.visit(index),
      background: (color) => this.paint(color),
      reset: () => this.reset(),
      share: () => copy(this.link(this.state), (text) => this.say(text)),
      fullscreen: () => this.fullscreen(),
    });
    root.classList.add("player");
    root.append(this.stage, this.bar.root);
    const changed = (change) => (...numbers) => {
      if (!this.view) return;
      this.bar.cameras.value = "";
      this.look(change(this.view, ...numbers));
    };
    listen(this.stage, {
      orbit: changed((view, yaw, pitch) => orbit(view, this.facts.units.up, yaw, pitch)),
      pan: changed((view, x, y) => pan(view, x, y, this.camera(1))),
      zoom: changed(zoom),
      hold: (held) => this.change(held),
      reset: () => this.reset(),
      keys: {
        " ": () => this.play(!this.playing),
        ",": () => this.seek(Math.max(0, this.time - 0.01)),
        ".": () => this.seek(Math.min(1, this.time + 0.01)),
        Home: () => this.reset(),
        f: () => this.fullscreen(),
      },
    });
    new ResizeObserver(() => this.change()).observe(this.stage);
  }

  /**
   * Show a capture through the server's pictures: what its cameras see.
   * @param {any} facts cameras, units and background, as scene files have them
   * @param {string | null} pictures address of /render with its job; null: there is no server
   */
  open(facts, pictures) {
    this.facts = facts;
    this.pictures = pictures && new Pictures(pictures, this.image, (error) => this.say(error ? error.message : ""));
    this.bar.list(facts.cameras);
    this.bar.enable(true);
    this.view = viewpointOf(facts.start);
    this.setTime(0);
    this.change();
  }

  /**
   * Fetch a scene file and play it.
   * @param {string} address
   */
  async load(address) {
    const number = ++this.loads;
    this.progress.removeAttribute("value"); // unknown until the file comes
    this.progress.hidden = false;
    try {
      const bytes = await download(address, (part) => (this.progress.value = part));
      if (number === this.loads) await this.use(bytes, () => number === this.loads);
    } finally {
      if (number === this.loads) this.progress.hidden = true;
    }
  }

  /**
   * Play the scene in a file.
   * @param {ArrayBuffer} bytes
   * @param {() => boolean} wanted whether it still is, once it is read
   */
  async use(bytes, wanted = () => true) {
    const scene = await readScene(bytes);
    if (!wanted()) return;
    const canvas = element("canvas", { "aria-hidden": "true" });
    const renderer = new Renderer(canvas, scene);
    if (!this.facts) this.open(scene.header.capture, null);
    const sorter = new Sorter(scene, this.worker, (order) => {
      renderer.setOrder(order);
      // What was shown before remains until the new scene can be drawn.
      if (this.sorter !== sorter && wanted()) this.show({ canvas, renderer, sorter });
      else if (this.sorter !== sorter) [sorter, renderer].forEach((unused) => unused.close());
      this.dirty = true;
      this.wake();
    });
    sorter.sort(this.camera(1), this.time);
  }

  /** Draw with this renderer from now on. */
  show({ canvas, renderer, sorter }) {
    this.release();
    this.canvas.replaceWith(canvas);
    Object.assign(this, { canvas, renderer, sorter });
    if (this.pictures) this.pictures.alone = false;
    this.root.dataset.ready = renderer.scene.header.digest;
    this.resolution.begin(renderer.measure(this.camera(window.devicePixelRatio), this.time, this.colors));
    canvas.addEventListener("webglcontextlost", () => this.renderer === renderer && this.lose());
    this.change();
  }

  /** The browser has taken the graphics memory away: the server's pictures remain. */
  lose() {
    this.release();
    if (this.pictures) this.pictures.alone = true;
    else this.say("The browser has stopped drawing. Reload the page.");
    this.change();
  }

  /** Forget the scene: another one comes, or none. */
  release() {
    this.sorter?.close();
    this.renderer?.close();
    Object.assign(this, { renderer: null, sorter: null });
    delete this.root.dataset.ready;
  }

  /** Forget everything. */
  clear(message = "") {
    this.loads++;
    this.play(false);
    clearTimeout(this.timer);
    this.release();
    this.pictures?.close();
    Object.assign(this, { facts: null, pictures: null, view: null });
    this.canvas.width = this.canvas.width; // emptied
    this.progress.hidden = true;
    this.bar.enable(false);
    this.say(message);
  }

  say(text) {
    this.message.textContent = text;
  }

  // ---- what people do

  look(view) {
    this.view = view;
    this.change();
  }

  seek(time) {
    this.setTime(time);
    this.change();
  }

  setTime(time) {
    this.bar.showTime((this.time = time));
  }

  play(on) {
    this.playing = on && this.facts !== null;
    if (this.playing && !this.looping && this.time >= 1) this.setTime(0);
    this.bar.showPlaying(this.playing);
    this.before = 0;
    this.change();
  }

  visit(index) {
    const camera = this.facts.cameras[index];
    this.setTime(camera.time);
    this.look(viewpointOf(camera));
  }

  paint(color) {
    this.background = color && rgb(color);
    this.change();
  }

  reset() {
    this.bar.cameras.value = "";
    if (this.facts) this.look(viewpointOf(this.facts.start));
  }

  fullscreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else this.root.requestFullscreen();
  }

  /** View and time as text for a link; what does not fit is left as it is. */
  get state() {
    return stateText(this.time, this.view);
  }

  set state(text) {
    const { time, view } = stateFrom(text);
    if (time !== null) this.setTime(time);
    if (view) this.look(view);
  }

  // ---- drawing

  /** The camera at a number of pixels for each one of the page. */
  camera(scale) {
    const [width, height] = [this.stage.clientWidth, this.stage.clientHeight].map((side) => Math.max(1, Math.round(side * scale)));
    const [w, h] = this.facts.start.size;
    return cameraOf(this.view, width, height, w / h);
  }

  get colors() {
    return this.background ?? this.facts.background;
  }

  /** Something is not as it was drawn: the view, the time, the background, or whether a hand holds it. */
  change(held = this.held) {
    this.held = held;
    this.dirty = this.stale = this.moving = true;
    if (this.renderer) this.pictures?.hide();
    clearTimeout(this.timer);
    if (this.facts && !this.playing && !this.held) {
      this.timer = setTimeout(() => {
        this.moving = false;
        this.dirty = true; // once more in full resolution
        this.wake();
        this.exact(window.devicePixelRatio, EXACT_SIDE);
        this.settled();
      }, SETTLE_MS);
    }
    this.wake();
  }

  wake() {
    if (!this.frame && this.facts) this.frame = requestAnimationFrame((now) => this.step(now));
  }

  step(now) {
    this.frame = 0;
    if (!this.facts) return;
    if (this.playing && (this.renderer || !this.pictures?.busy)) {
      if (this.before) this.advance(now - this.before);
      this.before = now;
    }
    if (this.dirty || this.playing) {
      this.dirty = false;
      if (this.renderer) this.drawScene();
      else if (this.stale) this.exact(1, DRAFT_SIDE);
      this.stale = false;
    }
    if (this.playing) this.wake();
  }

  drawScene() {
    const { scale } = this.resolution;
    const camera = this.camera(window.devicePixelRatio * (this.moving ? scale : 1));
    if (this.stale) this.sorter.sort(camera, this.time);
    this.renderer.draw(camera, this.time, this.colors, !this.moving || scale === 1);
  }

  advance(milliseconds) {
    if (this.renderer) this.resolution.adapt(milliseconds);
    const next = this.time + (milliseconds * this.speed) / PLAY_MS;
    const ends = next >= 1 && !this.looping;
    this.setTime(ends ? 1 : next % 1);
    if (ends) this.play(false);
    this.stale = true;
  }

  /** The server's picture of this view, of at most `side` pixels. */
  exact(scale, side) {
    if (!this.pictures) return;
    const most = side / Math.max(this.stage.clientWidth, this.stage.clientHeight);
    this.pictures.show(this.camera(Math.min(scale, most)), this.time, this.colors, this.facts.units);
  }
}
