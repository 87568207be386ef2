// Start of an exported page: its scene and its worker are elements of the page.

const textOf = (id) => document.getElementById(id).textContent;
const player = new Player(document.getElementById("player"), {
  worker: URL.createObjectURL(new Blob([textOf("worker")], { type: "text/javascript" })),
  link: (state) => `${location.href.split("#")[0]}#${state}`,
});
const bytes = Uint8Array.from(atob(textOf("scene")), (letter) => letter.charCodeAt(0));
try {
  if (!Renderer.isSupported()) throw new Error("This browser has no WebGL2, which the player needs.");
  await player.use(bytes.buffer);
  player.state = location.hash.slice(1);
  if (!location.hash) player.play(true);
  // A link is opened in the same tab.
  window.addEventListener("hashchange", () => {
    if (!location.hash) return;
    player.play(false);
    player.state = location.hash.slice(1);
  });
} catch (error) {
  player.say(error.message);
}
