// Elements, numbers and spans of time as people read them.

export function element(name, attributes = {}, text = null) {
  const node = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== null) node.textContent = text;
  return node;
}

export const count = (number) => Math.round(number).toLocaleString("en").replaceAll(",", " ");

export function span(seconds) {
  const whole = Math.round(seconds); // before it is split, or there would be 60 seconds in a minute
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${whole % 60} s`;
  const minutes = Math.round(seconds / 60);
  return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

export function ago(moment) {
  const seconds = (Date.now() - new Date(moment)) / 1000;
  return seconds < 5 ? "just now" : `${span(seconds).replace(/ \d+ (s|min)$/, "")} ago`;
}

