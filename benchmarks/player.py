"""The player beside Spark: bytes, seconds to the first picture, PSNR, and milliseconds of sorting and drawing.

    apt-get install chromium; npm install @sparkjsdev/spark@2.2.0 three@0.180.0
    python benchmarks/player.py RUN... --node-modules node_modules [--px 800] [--frames 10]

Both draw in headless Chromium, in software (SwiftShader) where there is no GPU. The player gets its scene file, which
holds all times; Spark gets the .spz and .ply of each time, because it plays no motion. PSNR against the exact image at
three training cameras and three times; a frame has 800 px (--px) on the longer side, is seen by the first of them, and
waits for the GPU. Prints a Markdown table.
"""

from __future__ import annotations

import argparse
import base64
import functools
import http.server
import shutil
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Page, sync_playwright

from graings.camera.camera import Camera
from graings.capture.image_file import decode
from graings.evaluation.metrics import psnr
from graings.export.export import ExportRequest, export_splats
from graings.export.harmonics_fit import spread
from graings.player.capture_cameras import MOST
from graings.player.html import player_html
from graings.player.scene_file import scene_bytes
from graings.render import PreparedScene, render
from graings.storage.compact import open_model
from graings.storage.model import Model

FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
TIMES = (0.0, 0.33, 0.8)
HEAD = "| run | drawn by | Gaussians | bytes | page | first picture | PSNR | sort | frame |\n" + 9 * "|---" + "|"

# Draws view `index` at `time`, `frames` times at the longer side `px`; 0 frames: once at the camera's own size.
OURS = """
async ([index, time, px, frames]) => {
  const facts = player.facts.cameras[index];
  let [width, height] = facts.size;
  const scale = frames ? px / Math.max(width, height) : 1;
  [width, height] = [Math.round(width * scale), Math.round(height * scale)];
  const camera = cameraOf(viewpointOf(facts), width, height, width / height);
  const canvas = document.createElement("canvas");
  const renderer = new Renderer(canvas, player.renderer.scene);
  const begun = performance.now();
  const order = await new Promise((resolve) => {
    new Sorter(player.renderer.scene, player.worker, resolve).sort(camera, time);
  });
  const sort = performance.now() - begun;
  renderer.setOrder(order);
  const pixel = new Uint8Array(4), gl = renderer.gl, spent = [];
  for (let frame = 0; frame <= frames; frame++) {
    const started = performance.now();
    renderer.draw(camera, time, player.facts.background);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    spent.push(performance.now() - started);
  }
  const picture = canvas.toDataURL("image/png");
  renderer.close();
  return { picture, sort, frame: spent.slice(1).sort((a, b) => a - b)[Math.floor(frames / 2)] };
}
"""

SPARK = """<!doctype html><meta charset="utf-8">
<script type="importmap">{"imports": {
  "three": "/modules/three/build/three.module.min.js",
  "three/addons/": "/modules/three/examples/jsm/",
  "@sparkjsdev/spark": "/modules/@sparkjsdev/spark/dist/spark.module.min.js"}}</script>
<script type="module">
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";

// The view of a pinhole camera: `pose` is camera to world, row by row, in OpenCV's axes.
function cameraOf({ pose, fx, fy, cx, cy, width, height }) {
  const camera = new THREE.Camera();
  const near = 0.01, far = 1000;
  camera.projectionMatrix.set(
    2 * fx / width, 0, 1 - 2 * cx / width, 0,
    0, 2 * fy / height, 2 * cy / height - 1, 0,
    0, 0, (far + near) / (near - far), 2 * far * near / (near - far),
    0, 0, -1, 0);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  camera.matrixAutoUpdate = false;
  camera.matrix.set(...pose).multiply(new THREE.Matrix4().makeScale(1, -1, -1));
  camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  return camera;
}

const loaded = new Map();
async function meshOf(url) {
  if (!loaded.has(url)) {
    const mesh = new SplatMesh({ url });
    await mesh.initialized;
    loaded.set(url, mesh);
  }
  return loaded.get(url);
}

window.drawn = async ({ url, view, background, frames }) => {
  const started = performance.now();
  const canvas = document.createElement("canvas");
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
  renderer.setPixelRatio(1);
  renderer.setSize(view.width, view.height, false);
  renderer.setClearColor(new THREE.Color().setRGB(...background, THREE.SRGBColorSpace), 1);
  const spark = new SparkRenderer({ renderer });
  const scene = new THREE.Scene();
  scene.add(spark, await meshOf(url));
  const camera = cameraOf(view), gl = renderer.getContext(), pixel = new Uint8Array(4);
  const draw = () => {
    renderer.render(scene, camera);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
  };
  // It sorts in a worker and draws with the newest order: until nothing changes any more.
  let before = "", same = 0, first = 0;
  for (let round = 0; round < 100 && same < 4; round++) {
    draw();
    await new Promise((resolve) => setTimeout(resolve, 100));
    const now = canvas.toDataURL("image/png");
    same = now === before ? same + 1 : 0;
    if (!same) first = performance.now() - started;
    before = now;
  }
  const spent = [];
  for (let frame = 0; frame < frames; frame++) {
    const begun = performance.now();
    draw();
    spent.push(performance.now() - begun);
  }
  scene.clear();
  renderer.dispose();
  renderer.forceContextLoss();
  return { picture: before, frame: spent.sort((a, b) => a - b)[Math.floor(frames / 2)], first };
};
window.ready = true;
</script>"""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address at which `folder` is served."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()


def image(address: str, folder: Path) -> NDArray[np.float32]:
    """RGB of a data URL."""
    path = folder / "picture.png"
    path.write_bytes(base64.b64decode(address.partition(",")[2]))
    return decode(path, path.name)[..., :3]


def exact(model: Model, prepared: PreparedScene, index: int, time: float) -> NDArray[np.float32]:
    view = model.views["train"][index]
    found: NDArray[np.float32] = render(prepared, view.camera, time, model.background).color.clamp(0, 1).numpy()
    return found


def chosen(model: Model) -> list[tuple[int, int]]:
    """Three training views: their places in the page's list of cameras, and in the model's views."""
    listed = spread(len(model.views["train"]), MOST["train"])
    return [(place, listed[place]) for place in (0, len(listed) // 3, 2 * len(listed) // 3)]


def our_row(page: Page, model: Model, name: str, folder: Path, px: int, frames: int) -> str:
    data = scene_bytes(model)
    end = "</script>\n</body>"
    text = player_html(data).decode()
    reachable = "Object.assign(window, { player, Renderer, Sorter, cameraOf, viewpointOf });\n"
    (folder / "ours.html").write_text(text.replace(end, reachable + end))
    page.goto((folder / "ours.html").as_uri())
    page.locator("#player[data-ready]").wait_for()
    first = page.evaluate("performance.now()")
    page.get_by_role("button", name="Pause").click()
    prepared = PreparedScene(model.scene)
    found = [
        psnr(image(page.evaluate(OURS, [place, t, px, 0])["picture"], folder), exact(model, prepared, index, t))
        for place, index in chosen(model)
        for t in TIMES
    ]
    timed = page.evaluate(OURS, [0, TIMES[1], px, frames])
    code = len(text) - 4 * len(data) // 3
    return (
        f"| {name} | player, all times | {prepared.children:,} | {len(data):,} | {code:,} | {first / 1000:.1f} s | "
        f"{min(found):.1f} to {max(found):.1f} dB | {timed['sort']:.0f} ms | {timed['frame']:.0f} ms |"
    )


def spark_row(
    page: Page, model: Model, name: str, suffix: str, folder: Path, address: str, px: int, frames: int
) -> str:
    prepared = PreparedScene(model.scene)

    def drawn(number: int, camera: Camera, frames: int) -> dict[str, Any]:
        pose = np.linalg.inv(model.units.camera_back(camera))
        if suffix == ".spz":  # its axes are turned by half about x
            pose = np.diag([1.0, -1.0, -1.0, 1.0]) @ pose
        view = {"pose": pose.ravel().tolist(), "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
        view |= {"width": camera.width, "height": camera.height}
        ask = {"url": f"{address}/{number}{suffix}", "view": view, "background": model.background, "frames": frames}
        answer: dict[str, Any] = page.evaluate("drawn", ask)
        return answer

    found, sizes, first, count = [], [], 0.0, 0
    for number, time in enumerate(TIMES):
        exported = export_splats(model, ExportRequest(suffix[1:], time=time))
        (folder / f"{number}{suffix}").write_bytes(exported.data)
        sizes.append(len(exported.data))
        count = exported.splats
        for _, index in chosen(model):
            answer = drawn(number, model.views["train"][index].camera, 0)
            first = first or answer["first"]
            found.append(psnr(image(answer["picture"], folder), exact(model, prepared, index, time)))
    camera = model.views["train"][0].camera
    scale = px / max(camera.width, camera.height)
    timed = drawn(1, camera.resized(round(scale * camera.width), round(scale * camera.height)), frames)
    modules = folder / "modules"
    code = sum(
        (modules / file).stat().st_size
        for file in (
            "three/build/three.module.min.js",
            "three/build/three.core.min.js",
            "@sparkjsdev/spark/dist/spark.module.min.js",
        )
    )
    return (
        f"| {name} | Spark, {suffix} of one time | {count:,} | {sizes[0]:,} | {code:,} | {first / 1000:.1f} s | "
        f"{min(found):.1f} to {max(found):.1f} dB | | {timed['frame']:.0f} ms |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--node-modules", type=Path, required=True)
    parser.add_argument("--px", type=int, default=800)
    parser.add_argument("--frames", type=int, default=10)
    options = parser.parse_args()
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    print(HEAD, flush=True)
    with tempfile.TemporaryDirectory() as name, sync_playwright() as driver:
        folder = Path(name)
        (folder / "modules").symlink_to(options.node_modules.resolve())
        (folder / "spark.html").write_text(SPARK)
        browser = driver.chromium.launch(executable_path=chromium, args=FLAGS)
        with served(folder) as address:
            for run in options.runs:
                model = open_model(run)
                page = browser.new_page()
                page.set_default_timeout(600_000)
                print(our_row(page, model, run.name, folder, options.px, options.frames), flush=True)
                page.close()
                page = browser.new_page()
                page.set_default_timeout(600_000)
                page.on("console", lambda said: said.type == "error" and print(said.text))
                page.on("pageerror", lambda error: print(error))
                page.goto(f"{address}/spark.html")
                page.wait_for_function("window.ready")
                for suffix in (".ply", ".spz"):
                    print(
                        spark_row(page, model, run.name, suffix, folder, address, options.px, options.frames),
                        flush=True,
                    )
                page.close()
        browser.close()


if __name__ == "__main__":
    main()
