// Job list: a row with name, state and progress of each job.

import { ago, count, element, span } from "./format.js";
import { Rows } from "./rows.js";

export class JobList {
  /**
   * @param {HTMLElement} root
   * @param {(id: string) => void} chosen
   */
  constructor(root, chosen) {
    this.current = null;
    this.rows = new Rows(root, () => this.row(chosen));
  }

  /**
   * @param {any[]} jobs resources
   * @param {string | null} current id of the chosen job
   */
  show(jobs, current) {
    this.current = current;
    this.rows.show(jobs);
  }

  row(chosen) {
    const node = element("li");
    const button = element("button", { type: "button" });
    const [top, title, state, sub] = ["top", "title", "state", "sub"].map((name) => element("span", { class: name }));
    const progress = element("progress", { "aria-label": "Progress" });
    top.append(title, state);
    button.append(top, progress, sub);
    node.append(button);
    const show = (job) => {
      button.setAttribute("aria-current", String(job.id === this.current));
      button.onclick = () => chosen(job.id);
      title.textContent = job.name;
      state.textContent = job.state;
      state.className = `state ${job.state}`;
      sub.textContent = summary(job);
      const report = job.progress;
      progress.hidden = !report || (job.state !== "running" && job.state !== "cancelled");
      if (progress.hidden) return;
      progress.max = report.iterations;
      progress.value = report.iteration;
    };
    return { node, show };
  }
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
