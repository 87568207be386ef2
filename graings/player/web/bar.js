// Bar: the controls below the stage.

/**
 * An element with attributes, and text or children.
 * @param {string} name
 * @param {Object<string, string>} attributes
 * @param {...(Node | string)} children
 */
export function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
const BACKGROUNDS = { capture: "As captured", "#ffffff": "White", "#000000": "Black", "#808080": "Grey", custom: "Other…" };

/**
 * @typedef {object} BarActions
 * @property {() => void} play
 * @property {(time: number) => void} seek
 * @property {(on: boolean) => void} loop
 * @property {(speed: number) => void} speed
 * @property {(index: number) => void} visit a camera of the capture, by its place in the list
 * @property {(color: string | null) => void} background #rrggbb, or null for that of the capture
 * @property {() => void} reset
 * @property {() => void} share
 * @property {() => void} fullscreen
 */

export class Bar {
  /** @param {BarActions} actions */
  constructor(actions) {
    const button = (text, label, act) => {
      const made = element("button", { type: "button", class: "quiet", "aria-label": label, title: label }, text);
      made.addEventListener("click", act);
      return made;
    };
    this.play = button("▶", "Play", actions.play);
    this.play.setAttribute("aria-pressed", "false");
    this.time = element("input", { type: "range", min: "0", max: "1", step: "0.001", value: "0", "aria-label": "Time" });
    this.time.addEventListener("input", () => actions.seek(Number(this.time.value)));
    this.clock = element("output", { class: "clock" }, "0.000");
    this.loop = button("↻", "Repeat", () => {
      const on = this.loop.getAttribute("aria-pressed") !== "true";
      this.loop.setAttribute("aria-pressed", String(on));
      actions.loop(on);
    });
    this.loop.setAttribute("aria-pressed", "true");
    this.speed = element("select", { "aria-label": "Speed" }, ...SPEEDS.map((x) => element("option", { value: String(x) }, `${x}×`)));
    this.speed.value = "1";
    this.speed.addEventListener("change", () => actions.speed(Number(this.speed.value)));
    this.cameras = element("select", { "aria-label": "Camera" });
    this.cameras.addEventListener("change", () => this.cameras.value !== "" && actions.visit(Number(this.cameras.value)));
    this.background = element("select", { "aria-label": "Background" }, ...Object.entries(BACKGROUNDS).map(([value, text]) => element("option", { value }, text)));
    this.color = element("input", { type: "color", value: "#336699", "aria-label": "Background colour" });
    this.color.hidden = true;
    const paint = () => {
      const custom = this.background.value === "custom";
      this.color.hidden = !custom;
      actions.background(custom ? this.color.value : this.background.value === "capture" ? null : this.background.value);
    };
    this.background.addEventListener("change", paint);
    this.color.addEventListener("input", paint);
    this.share = button("Link", "Copy a link to this view and time", actions.share);
    this.full = button("Full", "Full screen", actions.fullscreen);
    this.full.hidden = !document.fullscreenEnabled;
    this.root = element(
      "div",
      { class: "bar" },
      element("div", { class: "line" }, this.play, this.time, this.clock, this.loop, this.speed),
      element("div", { class: "line" }, this.cameras, this.background, this.color, element("span", { class: "space" }), button("⌂", "Back to the first view", actions.reset), this.share, this.full),
    );
    this.enable(false);
  }

  /** @param {boolean} on whether there is something to control */
  enable(on) {
    for (const control of this.root.querySelectorAll("button, input, select")) control.disabled = !on;
  }

  /**
   * The cameras that can be visited.
   * @param {{name: string}[]} cameras
   */
  list(cameras) {
    const groups = new Map([["train", "Training cameras"], ["val", "Held-out cameras"]]);
    const chosen = this.cameras.value;
    this.cameras.replaceChildren(element("option", { value: "" }, "Go to camera…"));
    for (const [split, label] of groups) {
      const group = element("optgroup", { label });
      cameras.forEach((camera, index) => {
        if (camera.name.startsWith(`${split}:`)) group.append(element("option", { value: String(index) }, camera.name));
      });
      if (group.children.length) this.cameras.append(group);
    }
    this.cameras.value = chosen;
    if (this.cameras.selectedIndex < 0) this.cameras.value = "";
  }

  showTime(time) {
    this.time.value = String(time);
    this.clock.textContent = time.toFixed(3);
  }

  showPlaying(on) {
    this.play.textContent = on ? "❚❚" : "▶";
    this.play.setAttribute("aria-label", on ? "Pause" : "Play");
    this.play.title = on ? "Pause" : "Play";
    this.play.setAttribute("aria-pressed", String(on));
  }
}
