// Options: a form made from the schema of the training options. Fields show the values of the chosen preset; what is
// changed is sent.

import { element } from "./format.js";

const PRESET = "standard"; // the service's default, chosen again whenever the form is reset
// The ones that most people change; all others are folded.
const COMMON = ["iterations", "capture.max_side", "capture.background", "capture.test_every", "density.max_anchors", "seed"];

export class OptionsForm {
  /**
   * @param {HTMLElement} root
   * @param {HTMLSelectElement} preset
   */
  constructor(root, preset) {
    this.preset = preset;
    this.fields = new Map(); // by dotted name: the field, its input and its schema
    this.search = element("input", { type: "search", placeholder: "Search options", "aria-label": "Search options" });
    this.common = element("div", { class: "fields" });
    this.expert = element("details");
    this.more = element("div", { class: "fields" });
    this.expert.append(element("summary", {}, "Expert options"), this.more);
    this.none = element("p", { class: "hint", hidden: "" }, "No option has these words.");
    root.append(this.search, this.common, this.expert, this.none);
    this.search.oninput = () => this.filter();
    this.search.onkeydown = (event) => event.key === "Enter" && event.preventDefault();
    preset.addEventListener("change", () => this.reset());
  }

  /** @param {{schema: any, presets: Object<string, any>}} all as /options gives them */
  fill({ schema, presets }) {
    this.presets = presets;
    this.preset.replaceChildren(...Object.keys(presets).map((name) => element("option", name === PRESET ? { selected: "" } : {}, name)));
    for (const [name, described] of leaves(schema, schema)) {
      if (name === "preset") continue;
      const input = control(described);
      input.id = `option-${name}`;
      const field = element("div", { class: "field" });
      const label = element("label", { for: input.id }, name);
      const help = element("p", { id: `help-${name}` }, described.description ?? "");
      input.setAttribute("aria-describedby", help.id);
      field.append(label, input, help);
      input.addEventListener("input", () => field.classList.toggle("changed", this.changed(name)));
      this.fields.set(name, { field, input, described });
    }
    for (const name of COMMON) if (this.fields.has(name)) this.common.append(this.fields.get(name).field);
    for (const [name, { field }] of this.fields) if (!COMMON.includes(name)) this.more.append(field);
    this.preset.form.addEventListener("reset", () => setTimeout(() => this.reset()));
    this.reset();
  }

  /** Values of the preset in all fields. */
  reset() {
    for (const [name, { field, input }] of this.fields) {
      const value = this.value(name);
      if (input.type === "checkbox") input.checked = value;
      else input.value = value === null ? "" : typeof value === "object" ? JSON.stringify(value) : String(value);
      field.classList.remove("changed");
    }
  }

  /** What the preset says. */
  value(name) {
    return name.split(".").reduce((inner, part) => inner?.[part], this.presets[this.preset.value]) ?? null;
  }

  entered(name) {
    const { input } = this.fields.get(name);
    if (input.type === "checkbox") return input.checked;
    const text = input.value.trim();
    if (text === "" || text === "null") return null;
    try {
      return JSON.parse(text);
    } catch {
      return text; // the name of a choice; the service checks it
    }
  }

  changed(name) {
    return JSON.stringify(this.entered(name)) !== JSON.stringify(this.value(name));
  }

  /** Changed options by dotted name. */
  values() {
    return Object.fromEntries([...this.fields.keys()].filter((name) => this.changed(name)).map((name) => [name, this.entered(name)]));
  }

  /** Show the options whose name or description has all words. */
  filter() {
    const words = this.search.value.toLowerCase().split(/\s+/).filter(Boolean);
    let shown = 0;
    for (const [name, { field, described }] of this.fields) {
      const text = `${name} ${described.description}`.toLowerCase();
      field.hidden = !words.every((word) => text.includes(word));
      shown += !field.hidden;
    }
    if (words.length) this.expert.open = [...this.more.children].some((field) => !field.hidden);
    this.none.hidden = shown > 0;
  }
}

/** Dotted name and schema of every option. */
function* leaves(schema, root, prefix = "") {
  for (const [name, property] of Object.entries(schema.properties)) {
    const reference = property.$ref ?? property.allOf?.[0]?.$ref;
    const inner = reference && root.$defs[reference.split("/").at(-1)];
    if (inner?.properties) yield* leaves(inner, root, `${prefix}${name}.`);
    else yield [prefix + name, inner ? { ...inner, ...property } : property];
  }
}

/** The input of an option. */
function control(described) {
  const kinds = described.anyOf ?? [described];
  const none = kinds.some((kind) => kind.type === "null");
  const others = kinds.filter((kind) => kind.type !== "null");
  const [kind] = others;
  if (kind.type === "boolean" && !none) return element("input", { type: "checkbox" });
  if (kind.enum && others.length === 1) {
    const select = element("select");
    if (none) select.append(element("option", { value: "" }, "none"));
    select.append(...kind.enum.map((value) => element("option", {}, String(value))));
    return select;
  }
  if (others.length > 1 || !["integer", "number"].includes(kind.type)) return element("input", { type: "text", spellcheck: "false" });
  const input = element("input", { type: "number", step: kind.type === "integer" ? "1" : "any" });
  for (const [bound, name] of [["minimum", "min"], ["maximum", "max"]]) if (kind[bound] !== undefined) input.setAttribute(name, kind[bound]);
  if (none) input.placeholder = "none";
  return input;
}
