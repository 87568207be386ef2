// Links: view and time as text at the end of an address.

import { viewpointFrom, viewpointText } from "./camera.js";

/**
 * @param {number} time
 * @param {import("./camera.js").Viewpoint} view
 */
export const stateText = (time, view) => `t=${time.toFixed(4)}&view=${viewpointText(view)}`;

/** Time and view in a text; null for each that is not in it. */
export function stateFrom(text) {
  const values = new URLSearchParams(text);
  const time = values.has("t") ? Number(values.get("t")) : NaN;
  return { time: time >= 0 && time <= 1 ? time : null, view: viewpointFrom(values.get("view") ?? "") };
}

/** Copy an address; without permission for the clipboard, show it. */
export async function copy(address, say) {
  try {
    await navigator.clipboard.writeText(address);
  } catch {
    prompt("This link restores view and time:", address);
    return;
  }
  say("The link is copied.");
  setTimeout(() => say(""), 2000);
}
