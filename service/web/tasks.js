// Tasks: the evaluations and videos of one job: ask for them, watch them, and show their results.

import { element } from "./format.js";
import { may, request } from "./requests.js";

const $ = (id) => document.getElementById(id);
const POLL_MS = 1000;

let shown = null; // address of the job's tasks
let timer = 0;

/**
 * Shows the tasks of a job, and looks again while one of them has not ended.
 * @param {any} job resource; one without a model has no tasks
 */
export function showTasks(job) {
  const address = may("read") ? job?.links.tasks : undefined;
  if (address === shown) return;
  shown = address;
  clearTimeout(timer);
  $("tasks").replaceChildren();
  if (address) look(address);
}

/**
 * Asks for a task and shows it.
 * @param {string} address what to POST to
 * @param {any} body of the request, if it has one
 */
export async function ask(address, body) {
  const json = { headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  await request(address, { method: "POST", ...(body ? json : {}) });
  clearTimeout(timer);
  await look(shown);
}

async function look(address) {
  try {
    const { tasks } = await request(address);
    if (address !== shown) return;
    const lines = await Promise.all(tasks.map(line));
    if (address !== shown) return;
    $("tasks").replaceChildren(...lines);
    if (tasks.some(pending)) timer = setTimeout(() => look(address), POLL_MS);
  } catch {
    timer = setTimeout(() => look(address), 5 * POLL_MS); // the service restarts; the page's health line says so
  }
}

async function line(task) {
  const item = element("li", {}, await text(task));
  if (task.links.video) item.append(element("a", { href: task.links.video }, "download"));
  return item;
}

const pending = (task) => ["queued", "running"].includes(task.state);

async function text(task) {
  const name = task.spec.kind === "video" ? `Video (${task.spec.format})` : `Evaluation of ${task.spec.split}`;
  if (task.links.metrics) {
    const { splits } = await request(task.links.metrics);
    const measured = splits[task.spec.split]?.psnr; // training a job for longer removes what its earlier model had
    return `${name}: ${measured == null ? "of an earlier model" : `${measured.toFixed(2)} dB`} `;
  }
  const { done, total } = task.progress ?? {};
  const state = pending(task) && total ? `${done} of ${total} frames` : task.state;
  return `${name}: ${task.error ?? state} `;
}
