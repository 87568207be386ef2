"""The time line of one request for an image, from the client and back.

    python benchmarks/request_timeline.py RUN [--side 400] [--requests 60] [--json FILE]

Starts `graings serve` with the model of RUN and asks for images of new times and azimuths on one kept connection, one
after the other. Medians in milliseconds for PNG and JPEG, exact and fast: the steps that the service reports in its
`Server-Timing` header, and `transfer`, the rest of what the client waits: parsing, routing, admission and validation
before the handler, sending and receiving after it.

- request: model and view of the query, ETag
- queue: until a rendering thread takes it
- scene: Gaussians of the time and colours of the view
- raster, encode
"""

from __future__ import annotations

import argparse
import http.client
import json
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from load import data_folder, serving

STEPS = ("request", "queue", "scene", "raster", "encode")
WARM_UPS = 5


def measured(connection: http.client.HTTPConnection, side: int, form: str, fast: bool, requests: int) -> dict[str, Any]:
    """Median milliseconds of each step, and bytes of an image."""
    steps: dict[str, list[float]] = {name: [] for name in (*STEPS, "transfer", "total")}
    size = 0
    for number in range(-WARM_UPS, requests):
        moment = ((number + WARM_UPS) * 0.6180339887498949) % 1.0
        query = f"width={side}&height={side}&t={moment:.9f}&azimuth={360 * moment:.6f}&format={form}"
        started = time.perf_counter()
        connection.request("GET", f"/render?{query}&fast={str(fast).lower()}")
        response = connection.getresponse()
        size = len(response.read())
        total = 1e3 * (time.perf_counter() - started)
        if response.status != 200:
            raise RuntimeError(f"the service answered {response.status}")
        header = response.headers["Server-Timing"]
        found = {name: float(ms) for name, ms in (part.split(";dur=") for part in header.split(", "))}
        if number >= 0:
            for name in STEPS:
                steps[name].append(found[name])
            steps["transfer"].append(total - sum(found.values()))
            steps["total"].append(total)
    medians = {name: round(statistics.median(values), 2) for name, values in steps.items()}
    return {"format": form, "fast": fast, "side": side, "bytes": size, **medians}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--side", type=int, default=400)
    parser.add_argument("--requests", type=int, default=60)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        data_folder(Path(folder), options.run, sys.executable)
        with serving(Path(folder), sys.executable, with_worker=False) as (port, _):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
            for form in ("png", "jpeg"):
                for fast in (False, True):
                    rows.append(measured(connection, options.side, form, fast, options.requests))
                    print(json.dumps(rows[-1]), flush=True)
    print("| format | " + " | ".join((*STEPS, "transfer", "total")) + " | KB |")
    print("|---" * (len(STEPS) + 4) + "|")
    for row in rows:
        name = f"{row['format']}{', fast' if row['fast'] else ''}"
        cells = [f"{row[step]:.2f}" for step in (*STEPS, "transfer", "total")]
        print(f"| {name} | {' | '.join(cells)} | {row['bytes'] / 1e3:.0f} |")
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
