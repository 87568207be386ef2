// Facts: the numbers of one job, its files, and what can be done with it.

import { attempt } from "./failure.js";
import { count, element, span } from "./format.js";
import { may, request } from "./requests.js";
import { Rows } from "./rows.js";
import { ask, showTasks } from "./tasks.js";

const $ = (id) => document.getElementById(id);
const FILES = { model: "model", metrics: "metrics.json", report: "report", log: "log" };
const files = new Rows($("files"), () => {
  const node = element("a");
  const show = ({ id, address }) => {
    node.href = address;
    node.textContent = FILES[id];
  };
  return { node, show };
});

/**
 * @param {any} job resource; none: show nothing
 * @param {{changed: () => Promise<void>, removed: () => void}} then
 */
export function showFacts(job, then) {
  $("facts").hidden = !job;
  showTasks(job);
  if (!job) return;
  const report = job.progress || {};
  const running = job.state === "running";
  const rows = [
    ["State", job.state],
    ["Iterations", report.iterations && `${count(report.iteration)} of ${count(report.iterations)}`],
    ["Phase", running && report.phase],
    ["Speed", running && report.iterations_per_s && `${report.iterations_per_s.toFixed(1)} it/s`],
    ["Time left", running && report.eta_s != null && span(report.eta_s)],
    ["Trained for", report.train_s != null && span(report.train_s)],
    ["Training views", report.psnr != null && `${report.psnr.toFixed(2)} dB`],
    ["Held-out views", report.held_out_psnr != null && `${report.held_out_psnr.toFixed(2)} dB`],
    ["Visible Gaussians", report.gaussians != null && count(report.gaussians)],
    ["Anchors", report.anchors != null && count(report.anchors)],
    ["Attempts", job.attempts > 1 && job.attempts],
    ["Last event", report.events?.length && eventText(report.events.at(-1))],
  ].filter(([, value]) => value);
  $("name").textContent = job.name;
  $("error").hidden = !job.error;
  $("error").textContent = job.error || "";
  $("numbers").replaceChildren(...rows.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, String(value))]));
  showActions(job, then);
  showCurve(job, report);
  const made = Object.keys(FILES).filter((key) => job.links[key] && may("read"));
  files.show(made.map((key) => ({ id: key, address: job.links[key] })));
}

const eventText = (event) => event.message ?? event;

function showActions(job, then) {
  $("actions").hidden = !may("train");
  const shown = `${job.id} ${job.state} ${Object.keys(job.links)}`;
  if ($("actions").dataset.shown === shown) return;
  $("actions").dataset.shown = shown;
  const button = (verb, run) => {
    const made = element("button", { type: "button", class: "quiet" }, verb[0].toUpperCase() + verb.slice(1));
    made.onclick = async () => {
      made.disabled = true;
      await attempt(async () => {
        await run();
        $("actions").dataset.shown = "";
        await then.changed();
      });
      made.disabled = false;
    };
    return made;
  };
  const verbs = ["cancel", "resume", "retry"].filter((verb) => job.links[verb]);
  const buttons = verbs.map((verb) => button(verb, () => request(job.links[verb], { method: "POST" })));
  if (job.links.evaluate) buttons.push(button("test views", () => ask(job.links.evaluate)));
  if (job.links.videos) buttons.push(button("video", () => ask(job.links.videos, { moves: "both" })));
  if (may("train")) buttons.push(button("share", () => share(job)));
  if (job.state !== "running") {
    buttons.push(button("delete", async () => {
      if (!confirm(`Delete "${job.name}" with its model?`)) return;
      await request(job.links.self, { method: "DELETE" });
      then.removed();
    }));
  }
  $("actions").replaceChildren(...buttons);
}

async function share(job) {
  const link = await request(`${job.links.self}/links?name=page`, { method: "POST" });
  prompt("Whoever has this address can look at the job until the link is revoked.", location.origin + link.address);
}

/** The picture of error against work; it opens at its own size. */
function showCurve(job, report) {
  const curve = $("curve");
  curve.hidden = !job.links.curve || !may("read");
  if (curve.hidden) return;
  const stamp = `${job.links.curve}?${Math.floor(report.train_s / 10)} ${job.state}`;
  if (curve.dataset.stamp === stamp) return;
  curve.dataset.stamp = stamp;
  curve.href = `${job.links.self}/report.svg`;
  curve.querySelector("img").src = `${job.links.curve}?at=${Date.now()}`;
}
