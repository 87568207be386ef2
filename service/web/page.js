// The page: jobs on the left, the scene in the middle, the numbers of one job on the right. All data come from the REST
// interface of the same server.

const $ = (id) => document.getElementById(id);
const RENDER_SIDE = 512;
const DRAFT_SIDE = 256; // while the viewpoint or the time changes
const LIST_EVERY_MS = 4000;
const PLAY_SECONDS = 4;

const jobs = new Map(); // job resources by id
let pages = 1;
let current = null; // id of the job in the middle
let stream = null;

// ---- requests

async function request(path, options) {
  const response = await fetch(path, options);
  if (response.status === 204) return null;
  const body = await response.json();
  if (!response.ok) throw new Error(body.detail || body.title || response.statusText);
  return body;
}

// ---- the session, if the service needs a key

let session = { scope: "admin", name: null };

async function signIn(secret) {
  await request("/session", { method: "POST", headers: { Authorization: `Bearer ${secret}` } });
  location.replace("/");
}

async function start() {
  const link = location.hash.match(/^#link=(.+)$/);
  try {
    if (link) return await signIn(link[1]);
    session = await request("/session");
  } catch (error) {
    document.querySelector("main").hidden = true;
    $("signin").hidden = false;
    if (link) $("signin").querySelector("[role=alert]").textContent = error.message;
    return;
  }
  $("upload").hidden = !may("train");
  document.body.classList.toggle("guest", !may("read"));
  $("signout").hidden = session.name === null;
  $("signout").textContent = `Sign out ${session.name}`;
  refresh();
}

const may = (scope) => ["view", "read", "train", "admin"].indexOf(session.scope) >= ["view", "read", "train", "admin"].indexOf(scope);

$("signin").onsubmit = (event) => {
  event.preventDefault();
  signIn(event.target.elements.key.value.trim()).catch((error) => {
    event.target.querySelector("[role=alert]").textContent = error.message;
  });
};
$("signout").onclick = () => request("/session", { method: "DELETE" }).then(() => location.replace("/"), showError);

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
  jobs.clear();
  for (const job of listed) jobs.set(job.id, job);
  showJobs();
  if (current === null) {
    const first = listed.find((job) => job.checkpoint !== null) || listed[0];
    if (first) choose(first.id);
  } else if (jobs.has(current)) {
    showJob(jobs.get(current));
  }
}

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
  $("jobs").replaceChildren(...rows);
}

function summary(job) {
  const report = job.progress;
  if (job.state === "queued") return report ? `waiting, continues from ${count(job.checkpoint || 0)}` : "waiting for a worker";
  if (!report) return job.state === "running" ? "starting" : ago(job.created_at);
  const done = `${count(report.iteration)} of ${count(report.iterations)}`;
  if (job.state !== "running") return `${done} · ${ago(job.finished_at || job.created_at)}`;
  if (report.phase === "capture") return `finding the cameras: ${report.step} ${count(report.step_done)} of ${count(report.step_total)}`;
  if (report.phase === "loading") return "loading the capture";
  return report.eta_s == null ? done : `${done} · ${span(report.eta_s)} left`;
}

function choose(id) {
  const changed = current !== id;
  current = id;
  showJobs();
  showJob(jobs.get(id));
  if (changed) {
    Object.assign(orbit, START);
    render();
    follow(id);
  }
}

function follow(id) {
  stream?.close();
  stream = new EventSource(`/jobs/${id}/events`);
  const update = (job) => {
    const before = jobs.get(id);
    jobs.set(id, job);
    showJobs();
    showJob(job);
    if (!before || before.checkpoint !== job.checkpoint) render();
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

function showJob(job) {
  $("facts").hidden = !job;
  if (!job) return;
  const report = job.progress || {};
  const rows = [
    ["State", job.state],
    ["Iterations", report.iterations && `${count(report.iteration)} of ${count(report.iterations)}`],
    ["Phase", job.state === "running" && report.phase],
    ["Speed", job.state === "running" && report.iterations_per_s && `${report.iterations_per_s.toFixed(1)} it/s`],
    ["Time left", job.state === "running" && report.eta_s != null && span(report.eta_s)],
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

  const verbs = ["cancel", "resume", "retry"].filter((verb) => job.links[verb]);
  $("actions").hidden = !may("train");
  const buttons = verbs.map((verb) => action(verb, () => request(job.links[verb], { method: "POST" })));
  if (may("train")) buttons.push(action("share", () => share(job)));
  if (job.state !== "running") {
    buttons.push(action("delete", async () => {
      if (!confirm(`Delete "${job.name}" with its model?`)) return;
      await request(job.links.self, { method: "DELETE" });
      jobs.delete(job.id);
      stream?.close();
      current = null;
    }));
  }
  if ($("actions").dataset.verbs !== `${job.id} ${job.state}`) {
    $("actions").dataset.verbs = `${job.id} ${job.state}`;
    $("actions").replaceChildren(...buttons);
  }
  const curve = $("curve");
  const stamp = `${job.links.curve}?${Math.floor(report.train_s / 10)} ${job.state}`;
  curve.hidden = !job.links.curve || !may("read");
  if (!curve.hidden && curve.dataset.stamp !== stamp) {
    curve.dataset.stamp = stamp;
    curve.src = `${job.links.curve}?at=${Date.now()}`;
  }
  const names = { model: "model", metrics: "metrics.json", report: "report", log: "log" };
  $("files").replaceChildren(
    ...Object.entries(names).filter(([key]) => job.links[key] && may("read")).map(([key, text]) => element("a", { href: job.links[key] }, text)),
  );
}

async function share(job) {
  const link = await request(`${job.links.self}/links?name=page`, { method: "POST" });
  prompt("Whoever has this address can look at the job until the link is revoked.", location.origin + link.address);
}

const eventText = (event) => event.message ?? event;

function action(verb, run) {
  const button = element("button", { type: "button", class: "quiet" }, verb[0].toUpperCase() + verb.slice(1));
  button.onclick = async () => {
    button.disabled = true;
    try {
      await run();
      $("actions").dataset.verbs = "";
      await list();
      if (current && jobs.get(current)) follow(current);
    } catch (error) {
      showError(error);
    }
    button.disabled = false;
  };
  return button;
}

// ---- the view: one request at a time, then the newest one

const START = { azimuth: 30, elevation: null, zoom: 1, radius: null };
const orbit = { ...START };
let busy = false;
let pending = null;
let settle = 0;

function render(side = RENDER_SIDE) {
  const job = jobs.get(current);
  if (!job || job.checkpoint === null) {
    $("view").hidden = true;
    $("empty").hidden = false;
    $("caption").textContent = "";
    $("time").disabled = $("play").disabled = true;
    return;
  }
  $("time").disabled = $("play").disabled = false;
  const query = new URLSearchParams({ job: job.id, t: $("time").value, width: side, height: side, format: "jpeg" });
  query.set("azimuth", orbit.azimuth.toFixed(2));
  if (orbit.elevation !== null) query.set("elevation", orbit.elevation.toFixed(2));
  if (orbit.zoom !== 1 && orbit.radius !== null) query.set("radius", (orbit.radius * orbit.zoom).toPrecision(6));
  pending = `/render?${query}`;
  if (side !== RENDER_SIDE) {
    clearTimeout(settle);
    settle = setTimeout(render, 250); // full resolution once the input stops
  }
  if (!busy) fetchView();
}

async function fetchView() {
  busy = true;
  while (pending !== null) {
    const address = pending;
    pending = null;
    try {
      const response = await fetch(address);
      if (!response.ok) throw new Error((await response.json()).detail);
      const image = $("view");
      const old = image.src;
      image.src = URL.createObjectURL(await response.blob());
      await image.decode();
      URL.revokeObjectURL(old);
      image.hidden = false;
      $("empty").hidden = true;
      const [, elevation, radius] = response.headers.get("X-Graings-Orbit").split(" ").map(Number);
      orbit.radius ??= radius;
      orbit.shown = elevation;
      const finished = response.headers.get("X-Graings-Finished") === "true";
      $("caption").textContent = finished ? "" : `iteration ${count(Number(response.headers.get("X-Graings-Iteration")))}, still training`;
    } catch (error) {
      showError(error);
      await new Promise((resolve) => setTimeout(resolve, 500));
    }
  }
  busy = false;
}

$("view").onpointerdown = (event) => {
  event.target.setPointerCapture(event.pointerId);
  event.target.classList.add("held");
};
$("view").onpointermove = (event) => {
  if (!event.buttons) return;
  orbit.azimuth = (orbit.azimuth - event.movementX * 0.5) % 360;
  orbit.elevation = Math.max(-89, Math.min(89, (orbit.elevation ?? orbit.shown ?? 20) + event.movementY * 0.4));
  render(DRAFT_SIDE);
};
$("view").onpointerup = (event) => {
  event.target.classList.remove("held");
  render();
};
$("view").ondblclick = () => {
  Object.assign(orbit, START);
  render();
};
$("frame").addEventListener("wheel", (event) => {
  event.preventDefault();
  orbit.zoom = Math.max(0.2, Math.min(5, orbit.zoom * Math.exp(event.deltaY * 0.001)));
  render(DRAFT_SIDE);
}, { passive: false });

let playing = null;
function setTime(t) {
  $("time").value = t;
  $("clock").value = Number($("time").value).toFixed(3);
  render(playing === null ? RENDER_SIDE : DRAFT_SIDE);
}
$("time").oninput = () => {
  $("clock").value = Number($("time").value).toFixed(3);
  render(DRAFT_SIDE);
};
$("play").onclick = () => {
  const on = playing === null;
  $("play").textContent = on ? "❚❚" : "▶";
  $("play").setAttribute("aria-pressed", String(on));
  if (!on) {
    cancelAnimationFrame(playing);
    playing = null;
    render();
    return;
  }
  let before = performance.now();
  const step = (now) => {
    playing = requestAnimationFrame(step);
    if (busy) return; // at most as fast as images are rendered
    setTime((Number($("time").value) + (now - before) / 1000 / PLAY_SECONDS) % 1);
    before = now;
  };
  playing = requestAnimationFrame(step);
};

// ---- upload of a capture

const form = $("upload");
const file = form.elements.capture;
file.onchange = () => ($("chosen").textContent = file.files[0]?.name || "Drop a capture here, or choose a zip or tar file");
for (const name of ["dragover", "dragleave", "drop"]) {
  $("drop").addEventListener(name, (event) => {
    event.preventDefault();
    $("drop").classList.toggle("over", name === "dragover");
    if (name === "drop") {
      file.files = event.dataTransfer.files;
      file.onchange();
    }
  });
}
form.onsubmit = (event) => {
  event.preventDefault();
  const capture = file.files[0];
  const query = new URLSearchParams({ preset: form.elements.preset.value, name: capture.name.replace(/\.(zip|tar|tgz|tar\.gz)$/i, "") });
  if (form.elements.config.value.trim()) query.set("config", form.elements.config.value);
  const upload = new XMLHttpRequest(); // fetch does not report the progress of an upload
  upload.open("POST", `/jobs?${query}`);
  upload.setRequestHeader("Content-Type", "application/octet-stream");
  upload.responseType = "json";
  upload.upload.onprogress = (progress) => ($("sending").value = progress.loaded / progress.total);
  upload.onloadend = () => {
    $("sending").hidden = true;
    if (upload.status === 202) {
      form.reset();
      file.onchange();
      list().then(() => choose(upload.response.id), showError);
    } else {
      $("refused").hidden = false;
      $("refused").textContent = upload.response?.detail || "The service does not answer.";
    }
  };
  $("refused").hidden = true;
  $("sending").hidden = false;
  upload.send(capture);
};

// ---- elements and formats

function element(name, attributes = {}, text = null) {
  const node = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== null) node.textContent = text;
  return node;
}

const count = (number) => Math.round(number).toLocaleString("en").replaceAll(",", " ");

function span(seconds) {
  if (seconds < 60) return `${Math.round(seconds)} s`;
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min ${Math.round(seconds % 60)} s`;
  return `${Math.floor(seconds / 3600)} h ${Math.round((seconds % 3600) / 60)} min`;
}

function ago(moment) {
  const seconds = (Date.now() - new Date(moment)) / 1000;
  return seconds < 5 ? "just now" : `${span(seconds).replace(/ \d+ (s|min)$/, "")} ago`;
}

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
