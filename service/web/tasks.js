// Tasks: the evaluations and videos of one job: ask for them, watch them, and show their results.

import { attempt } from "./failure.js";
import { element } from "./format.js";
import { may, request } from "./requests.js";
import { Rows } from "./rows.js";

const $ = (id) => document.getElementById(id);
const POLL_MS = 1000;

let shown = null; // address of the job's tasks
let timer = 0;
let looks = 0; // an earlier look that ends later shows nothing
const rows = new Rows($("tasks"), row);

/**
 * Shows the tasks of a job, and looks again while one of them has not ended.
 * @param {any} job resource; one without a model has no tasks
 */
export function showTasks(job) {
  const address = may("read") ? job?.links.tasks : undefined;
  if (address === shown) return;
  shown = address;
  rows.show([]);
  look();
}

/**
 * Asks for a task and shows it.
 * @param {string} address what to POST to
 * @param {any} body of the request, if it has one
 */
export async function ask(address, body) {
  const json = { headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  await request(address, { method: "POST", ...(body ? json : {}) });
  await look();
}

/** Shows what the tasks are now, and looks again soon while one of them has not ended. */
async function look() {
  const number = ++looks;
  clearTimeout(timer);
  if (!shown) return;
  try {
    const { tasks } = await request(shown);
    const items = await Promise.all(tasks.map(async (task) => ({ ...task, text: await text(task) })));
    if (number !== looks) return;
    rows.show(items);
    if (tasks.some(pending)) timer = setTimeout(look, POLL_MS);
  } catch {
    if (number === looks) timer = setTimeout(look, 5 * POLL_MS); // the service restarts; the page's health line says so
  }
}

/** A line with what became of a task, its video, and a button that stops or deletes it. */
function row() {
  const node = element("li");
  const said = element("span");
  const video = element("a", {}, "download");
  const remove = element("button", { type: "button", class: "quiet" });
  remove.hidden = !may("train");
  node.append(said, remove);
  const show = (task) => {
    said.textContent = task.text;
    if (task.links.video && !video.parentNode) said.after(video);
    video.href = task.links.video ?? "";
    remove.textContent = pending(task) ? "Stop" : "Delete";
    remove.setAttribute("aria-label", `${remove.textContent} ${title(task)}`);
    remove.onclick = () => attempt(() => stop(task, remove));
  };
  return { node, show };
}

async function stop(task, button) {
  button.disabled = true;
  try {
    await request(task.links.self, { method: "DELETE" });
  } finally {
    button.disabled = false;
  }
  await look();
}

const pending = (task) => ["queued", "running"].includes(task.state);

const title = ({ spec }) => (spec.kind === "video" ? `Video (${spec.format})` : `Evaluation of ${spec.split}`);

async function text(task) {
  if (task.links.metrics) {
    const { splits } = await request(task.links.metrics);
    const measured = splits[task.spec.split]?.psnr; // training a job for longer removes what its earlier model had
    return `${title(task)}: ${measured == null ? "of an earlier model" : `${measured.toFixed(2)} dB`}`;
  }
  const { done, total } = task.progress ?? {};
  const state = pending(task) && total ? `${done} of ${total} frames` : task.state;
  return `${title(task)}: ${task.error ?? state}`;
}
