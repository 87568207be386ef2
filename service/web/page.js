// The page: jobs on the left, the scene in the middle, the numbers of one job on the right. All data come from the REST
// interface of the same server.

import { showFacts } from "./facts.js";
import { attempt, showFailure } from "./failure.js";
import { JobList } from "./job_list.js";
import { may, request, session, signIn, signOut } from "./requests.js";
import { Stage } from "./stage.js";
import { uploadForm } from "./upload.js";

const $ = (id) => document.getElementById(id);
const LIST_EVERY_MS = 4000;

const jobs = new Map(); // job resources by id
let pages = 1;
let current = null; // id of the job in the middle
let stream = null;
let stage = null; // none while the page asks for a key
const rows = new JobList($("jobs"), (id) => attempt(() => choose(id)));

// ---- the session, if the service needs a key

/** The secret of a link, if the address has one. The address bar, where others could read it, loses it. */
function takeSecret() {
  const link = location.hash.match(/^#link=(.+)$/);
  if (link) history.replaceState(null, "", location.pathname);
  return link?.[1];
}

async function start() {
  const secret = takeSecret();
  try {
    if (secret) return await signIn(secret);
    Object.assign(session, await request("/session"));
  } catch (error) {
    document.querySelector("main").hidden = true;
    $("signin").hidden = false;
    if (secret) showFailure(error);
    return;
  }
  stage = new Stage($("player"));
  $("upload").hidden = !may("train");
  if (may("train")) uploadForm((id) => attempt(() => list().then(() => choose(id))));
  document.body.classList.toggle("guest", !may("read"));
  $("signout").hidden = session.name === null;
  $("signout").textContent = `Sign out ${session.name}`;
  refresh();
}

$("signin").onsubmit = (event) => {
  event.preventDefault();
  attempt(() => signIn(event.target.elements.key.value.trim()));
};
$("signout").onclick = () => attempt(signOut);

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
    const job = jobs.get(current);
    show(job);
    // A stream that is refused, as with too many requests, does not come back by itself; nor does that of a job that has ended.
    if (stream?.readyState === EventSource.CLOSED && ["queued", "running"].includes(job.state)) follow(current);
  }
}

/** Id of the job that the address names. */
const linked = () => new URLSearchParams(location.hash.slice(1)).get("job");

const showJobs = () => rows.show([...jobs.values()], current);

function choose(id) {
  const changed = current !== id;
  current = id;
  showJobs();
  show(jobs.get(id));
  if (changed) follow(id);
}

/** Show a job that may be older than those of the list. */
async function open(id) {
  if (!jobs.has(id)) jobs.set(id, await request(`/jobs/${id}`));
  choose(id);
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
  });
  const state = job && linked() === job.id ? location.hash.slice(1) : "";
  stage.show(job, state);
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
      request(`/jobs/${id}`).then((fresh) => current === id && update({ ...fresh, progress: jobs.get(id).progress }), showHealth);
    }
  });
  stream.addEventListener("state", (event) => update(JSON.parse(event.data)));
  stream.addEventListener("end", (event) => {
    update(JSON.parse(event.data));
    stream.close();
  });
}

window.addEventListener("hashchange", () => {
  const secret = takeSecret();
  if (secret) return attempt(() => signIn(secret));
  if (!stage) return;
  const id = linked();
  if (id && id !== current) attempt(() => open(id));
  else if (id === current) stage.player.state = location.hash.slice(1);
});

// ---- what is read again and again

const showHealth = ({ message }) => ($("health").textContent = message);

async function health() {
  const readiness = await request("/readyz");
  const workers = readiness.workers === 1 ? "1 worker" : `${readiness.workers} workers`;
  return { message: readiness.workers ? workers : "No worker: jobs wait. Start one with: graings worker" };
}

async function refresh() {
  const [healthy, listed] = await Promise.allSettled([health(), list()]); // a full disk must not hide what can be deleted
  showHealth(healthy.reason ?? listed.reason ?? healthy.value);
  setTimeout(refresh, LIST_EVERY_MS);
}

$("more").onclick = () => {
  pages += 1;
  attempt(list);
};
start();
