"""What a video costs: CPU milliseconds of a frame to render, to encode, and of both by `write_video`.

    python benchmarks/video.py RUN... [--frames 60] [--threads 1]

Frames of the path that `graings video` takes by default. Rendering and encoding are timed apart on the same frames; the
last column is the whole over their sum, so what `write_video` adds itself. CPU times count all threads of the process.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from graings import kernel
from graings.camera.view_request import ViewRequest
from graings.export.camera_path import frames_of
from graings.export.shown import open_shown
from graings.export.video import FORMATS, write_video
from graings.export.video_file import video_file
from graings.render import render


def cpu_ms(call: Callable[[], None], frames: int) -> float:
    """CPU milliseconds of a frame."""
    started = time.process_time()
    call()
    return 1e3 * (time.process_time() - started) / frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    print("| run | px | Gaussians | format | render | encode | whole | whole / sum | KB |\n" + 9 * "|---" + "|")
    with tempfile.TemporaryDirectory() as folder, kernel.computing_threads(options.threads):
        for run in options.runs:
            shown = open_shown(run)
            frames = frames_of(shown, ViewRequest(), None, "both", options.frames)
            camera, _ = frames[0]
            frames = [(camera.resized(camera.width & ~1, camera.height & ~1), time) for camera, time in frames]
            background = shown.background
            levels = []
            render(shown.scene, *frames[0], background)

            def rendered() -> None:
                for camera, moment in frames:  # noqa: B023
                    color = render(shown.scene, camera, moment, background).color.numpy()  # noqa: B023
                    levels.append(np.rint(np.clip(color, 0.0, 1.0) * 255.0).astype(np.uint8))  # noqa: B023

            of_render = cpu_ms(rendered, len(frames))
            gaussians = len(shown.scene.compose(camera.center, 0.5).gaussians)
            for suffix in (*FORMATS, ""):
                path = Path(folder) / run.name / f"video{suffix}"
                path.parent.mkdir(exist_ok=True)

                def encoded() -> None:
                    files = [path] if path.suffix else [Path(folder) / f"{k}.png" for k in range(len(levels))]  # noqa: B023
                    for file in files:
                        with video_file(file, camera.width & ~1, camera.height & ~1, 30.0) as add:  # noqa: B023
                            for frame in levels if path.suffix else levels[int(file.stem)][None]:  # noqa: B023
                                add(frame)

                of_encoding = cpu_ms(encoded, len(frames))
                whole = cpu_ms(lambda: write_video(path, shown, frames, background), len(frames))  # noqa: B023
                size = sum(file.stat().st_size for file in ([path] if suffix else path.iterdir()))
                kind, ratio = suffix or "PNG", whole / (of_render + of_encoding)
                print(
                    f"| {run.name} | {camera.width} | {gaussians:,} | {kind} | {of_render:.1f} ms | "
                    f"{of_encoding:.1f} ms | {whole:.1f} ms | {ratio:.2f} | {size / 1e3:.0f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
