// Upload: a capture, as an archive or a folder, with the options of its training.

import { element } from "./format.js";
import { OptionsForm } from "./options.js";
import { request } from "./requests.js";
import { filesOf, tar } from "./tar.js";

const $ = (id) => document.getElementById(id);
const PROMPT = "Drop a capture here: a folder, a zip or tar file, or a video";

/** @param {(id: string) => void} submitted gets the id of a new job */
export function uploadForm(submitted) {
  const form = $("upload");
  const options = new OptionsForm($("options"), form.elements.preset);
  let capture = null; // {name, body: Blob}
  let sent = null; // the capture that is being sent

  const allow = () => ($("train").disabled = !capture || sent !== null);
  const choose = (name, body) => {
    capture = name ? { name, body } : null;
    $("chosen").textContent = name || PROMPT;
    $("refused").hidden = true;
    allow();
  };
  const refuse = (text) => {
    $("refused").hidden = false;
    $("refused").textContent = text;
  };
  const chooseFolder = (name, entries) => {
    if (!entries.length) return refuse(`The folder ${name} is empty.`);
    choose(name, tar(entries));
    $("chosen").textContent = `${name}: ${entries.length} files`;
  };

  form.elements.capture.onchange = (event) => {
    const [file] = event.target.files;
    if (file) choose(file.name, file);
  };
  $("folder").onchange = (event) => {
    const files = [...event.target.files];
    if (files.length) chooseFolder(files[0].webkitRelativePath.split("/")[0], files.map((file) => ({ path: file.webkitRelativePath, file })));
  };
  for (const name of ["dragover", "dragleave", "drop"]) {
    $("drop").addEventListener(name, async (event) => {
      event.preventDefault();
      $("drop").classList.toggle("over", name === "dragover");
      if (name !== "drop") return;
      const [item] = event.dataTransfer.items;
      const entry = item?.webkitGetAsEntry?.();
      try {
        if (entry?.isDirectory) chooseFolder(entry.name, await filesOf(entry));
        else if (event.dataTransfer.files[0]) choose(event.dataTransfer.files[0].name, event.dataTransfer.files[0]);
      } catch (error) {
        refuse(error.message);
      }
    });
  }

  const query = (facts) => {
    const wanted = new URLSearchParams({ preset: form.elements.preset.value, ...facts });
    const changed = options.values();
    if (Object.keys(changed).length) wanted.set("config", JSON.stringify(changed));
    return wanted;
  };
  form.onsubmit = (event) => {
    event.preventDefault();
    if ($("train").disabled) return;
    sent = capture;
    allow();
    const upload = new XMLHttpRequest(); // fetch does not report the progress of an upload
    upload.open("POST", `/jobs?${query({ name: capture.name.replace(/\.(zip|tar|tgz|tar\.gz)$/i, "") })}`);
    upload.setRequestHeader("Content-Type", "application/octet-stream");
    upload.responseType = "json";
    upload.upload.onprogress = (progress) => ($("sending").value = progress.loaded / progress.total);
    upload.onloadend = () => {
      const another = capture !== sent; // chosen meanwhile, perhaps with options of its own
      $("sending").hidden = true;
      sent = null;
      allow();
      if (upload.status === 202) {
        if (!another) {
          form.reset();
          choose(null);
        }
        submitted(upload.response.id);
      } else {
        refuse(upload.response?.detail || "The service does not answer.");
      }
    };
    $("refused").hidden = true;
    $("sending").value = 0;
    $("sending").hidden = false;
    upload.send(capture.body);
  };
  const tryScene = async (scene, button) => {
    $("refused").hidden = true;
    button.disabled = true;
    try {
      const job = await request(`/jobs?${query({ scene })}`, { method: "POST" });
      $("examples").open = false;
      submitted(job.id);
    } catch (error) {
      refuse(error.message);
    }
    button.disabled = false;
  };
  const offer = (scenes) => {
    const rows = scenes.map(({ name, question }) => {
      const button = element("button", { type: "button", class: "quiet" }, name);
      button.onclick = () => tryScene(name, button);
      const row = element("li");
      row.append(button, element("span", {}, question));
      return row;
    });
    $("examples").querySelector("ul").replaceChildren(...rows);
  };
  choose(null);

  request("/options").then((all) => {
    options.fill(all);
    offer(all.scenes);
  }, (error) => refuse(error.message));
}
