// The page: jobs on the left, the scene in the middle, the numbers of one job on the right. All data come from the REST
// interface of the same server.

import { showFacts } from "./facts.js";
import { ago, count, element, span } from "./format.js";
import { may, request, session, signIn, signOut } from "./requests.js";
import { Stage } from "./stage.js";
import { uploadForm } from "./upload.js";

const $ = (id) => document.getElementById(id);
const LIST_EVERY_MS = 4000;

const jobs = new Map(); // job resources by id
let pages = 1;
let current = null; // id of the job in the middle
let stream = null;
let stage = null;

// ---- the session, if the service needs a key

async function start() {
  const link = location.hash.match(/^#link=(.+)$/);
  try {
    if (link) return await signIn(link[1]);
    Object.assign(session, await request("/session"));
  } catch (error) {
    document.querySelector("main").hidden = true;
    $("signin").hidden = false;
    if (link) $("signin").querySelector("[role=alert]").textContent = error.message;
    return;
  }
  stage = new Stage($("player"));
  $("upload").hidden = !may("train");
  if (may("train")) uploadForm((id) => list().then(() => choose(id), showError));
  document.body.classList.toggle("guest", !may("read"));
  $("signout").hidden = session.name === null;
  $("signout").textContent = `Sign out ${session.name}`;
  refresh();
}

$("signin").onsubmit = (event) => {
  event.preventDefault();
  signIn(event.target.elements.key.value.trim()).catch((error) => {
    event.target.querySelector("[role=alert]").textContent = error.message;
  });
};
$("signout").onclick = () => signOut().catch(showError);

// ---- jobs

async function list() {
  const listed = [];
  let path = "/jobs?limit=20";
  for (let page = 0; page < pages && path; page++) {
    const body = await request(path);
    listed.push(...body.jobs);
    path = body.next;
  }
  $("more").hidden = !path;
  const wanted = current ?? linked();
  if (wanted && !listed.some((job) => job.id === wanted)) {
    const older = await request(`/jobs/${wanted}`).catch(() => null); // deleted, or another's
    if (older) listed.push(older);
  }
  jobs.clear();
  for (const job of listed) jobs.set(job.id, job);
  showJobs();
  if (current === null) {
    const first = jobs.get(linked()) || listed.find((job) => job.checkpoint !== null) || listed[0];
    if (first) choose(first.id);
    else show(null);
  } else if (jobs.has(current)) {
    show(jobs.get(current));
  }
}

/** Id of the job that the address names. */
const linked = () => new URLSearchParams(location.hash.slice(1)).get("job");

function showJobs() {
  const rows = [...jobs.values()].map((job) => {
    const button = element("button", { type: "button", "aria-current": String(job.id === current) });
    const top = element("span", { class: "top" });
    top.append(element("span", { class: "title" }, job.name), element("span", { class: `state ${job.state}` }, job.state));
    button.append(top);
    const report = job.progress;
    if (report && (job.state === "running" || job.state === "cancelled")) {
      button.append(element("progress", { max: report.iterations, value: report.iteration, "aria-label": "Progress" }));
    }
    button.append(element("span", { class: "sub" }, summary(job)));
    button.onclick = () => choose(job.id);
    const row = element("li");
    row.append(button);
    return row;
  });
  const focused = [...$("jobs").querySelectorAll("button")].indexOf(document.activeElement);
  $("jobs").replaceChildren(...rows);
  if (focused >= 0) $("jobs").querySelectorAll("button")[focused]?.focus();
}

function summary(job) {
  const report = job.progress;
  if (job.state === "queued") return report ? `waiting, continues from ${count(job.checkpoint || 0)}` : "waiting for a worker";
  if (!report) return job.state === "running" ? "starting" : ago(job.created_at);
  const done = `${count(report.iteration)} of ${count(report.iterations)}`;
  if (job.state !== "running") return `${done} · ${ago(job.finished_at || job.created_at)}`;
  if (report.step === "drawing") return `drawing the images: ${count(report.step_done)} of ${count(report.step_total)}`;
  if (report.phase === "capture") {
    const parts = report.step_total > 1 ? ` ${count(report.step_done)} of ${count(report.step_total)}` : "";
    return `finding the cameras: ${report.step}${parts}`;
  }
  if (report.phase === "loading") return "loading the capture";
  return report.eta_s == null ? done : `${done} · ${span(report.eta_s)} left`;
}

function choose(id) {
  const changed = current !== id;
  current = id;
  showJobs();
  show(jobs.get(id));
  if (changed) follow(id);
}

function show(job) {
  showFacts(job, {
    changed: async () => {
      await list();
      if (current && jobs.get(current)) follow(current);
    },
    removed: () => {
      jobs.delete(job.id);
      stream?.close();
      current = null;
    },
    failed: showError,
  });
  const state = job && linked() === job.id ? location.hash.slice(1) : "";
  stage.show(job, state).catch(showError);
}

function follow(id) {
  stream?.close();
  stream = new EventSource(`/jobs/${id}/events`);
  const update = (job) => {
    jobs.set(id, job);
    showJobs();
    show(job);
  };
  let refreshed = Date.now();
  stream.addEventListener("progress", (event) => {
    const job = jobs.get(id);
    if (!job) return;
    update({ ...job, progress: JSON.parse(event.data) });
    if (Date.now() - refreshed > LIST_EVERY_MS) {
      refreshed = Date.now();
      request(`/jobs/${id}`).then((fresh) => current === id && update({ ...fresh, progress: jobs.get(id).progress }), showError);
    }
  });
  stream.addEventListener("state", (event) => update(JSON.parse(event.data)));
  stream.addEventListener("end", (event) => {
    update(JSON.parse(event.data));
    stream.close();
  });
}

window.addEventListener("hashchange", () => {
  const id = linked();
  if (id && id !== current && jobs.has(id)) choose(id);
  else if (id === current) stage.player.state = location.hash.slice(1);
});

function showError(error) {
  $("health").textContent = error.message;
}

async function health() {
  const readiness = await request("/readyz");
  const workers = readiness.workers === 1 ? "1 worker" : `${readiness.workers} workers`;
  $("health").textContent = readiness.workers ? workers : "No worker: jobs wait. Start one with: graings worker";
}

async function refresh() {
  try {
    await health();
    await list();
  } catch (error) {
    showError(error);
  }
  setTimeout(refresh, LIST_EVERY_MS);
}

$("more").onclick = () => {
  pages += 1;
  list().catch(showError);
};
start();
