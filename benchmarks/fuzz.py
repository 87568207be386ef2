"""Hostile input: mutated files of every kind that strangers may send, read by our readers in bounded processes.

    python benchmarks/fuzz.py [--count 10000] [--kinds images,json] [--seed 0] [--keep DIR] [--json FILE]

Each input is made from a valid seed by its number, the kind and `--seed`, so one can be made again. It is read, or
refused with an error class of ours that names the file, or a fault: another exception, the end of the process, more
than 3 GB or 60 CPU seconds, or a message with a path of the machine, a stack trace, the whole input or letters that do
not print. `--keep` writes the inputs of faults to a folder. The table is Markdown; the exit code is 1 after a fault.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from random import Random

from fuzzing.kinds import KINDS
from fuzzing.rows import Outcome, Row, distinct, table

BATCH = 10_000  # inputs that one process reads
WALL_S = 120.0  # without a line; CPU time is limited by the process itself


def run_kind(kind: str, seed: str, count: int, temporary: str) -> tuple[Row, list[Outcome]]:
    """All inputs of one kind. An input that ends the process is tried once more alone, to know that it was that one."""
    outcomes: list[Outcome] = []
    peak, slowest = 0, 0.0
    while len(outcomes) < count:
        start = len(outcomes)
        lines, ending = _read_batch(kind, seed, start, min(count, start + BATCH), temporary)
        for line in lines:
            outcomes.append(Outcome.model_validate(line["outcome"]))
            peak, slowest = max(peak, line["peak_mb"]), max(slowest, line["seconds"])
        if ending is not None:
            index = len(outcomes)
            _, again = _read_batch(kind, seed, index, index + 1, temporary)
            name = KINDS[kind].make(Random(f"{seed}/{kind}/{index}"))[0]
            place = again or f"alone it is read or refused; after others: {ending}"
            outcomes.append(Outcome(index=index, seed=name, error=ending, fault="the process ended", place=place))
    return Row.of(kind, outcomes, peak, slowest), outcomes


def _read_batch(kind: str, seed: str, start: int, stop: int, temporary: str) -> tuple[list[dict], str | None]:
    command = [sys.executable, "-m", "fuzzing.child", kind, seed, str(start), str(stop)]
    lines: list[dict] = []
    with tempfile.TemporaryFile("w+") as errors:
        child = subprocess.Popen(
            command,
            cwd=Path(__file__).parent,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env={"PATH": "/usr/bin:/bin", "GRAINGS_FUZZ_TMP": temporary, "OMP_NUM_THREADS": "1"},
        )
        assert child.stdout is not None
        stuck = signal.signal(signal.SIGALRM, lambda *_: child.kill())
        for text in child.stdout:
            signal.setitimer(signal.ITIMER_REAL, WALL_S)
            if text.startswith("{"):
                lines.append(json.loads(text))
        child.wait()
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, stuck)
        if child.returncode == 0 and len(lines) == stop - start:
            return lines, None
        errors.seek(0)
        last = (errors.read().strip().splitlines() or [""])[-1]
    code = child.returncode
    return lines, f"{signal.Signals(-code).name if code < 0 else f'exit {code}'} {last[:200]}".strip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--seed", default="0")
    parser.add_argument("--keep", type=Path, help="folder for the inputs of faults")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory(prefix="graings-fuzz-") as temporary:
        for kind in options.kinds.split(","):
            row, outcomes = run_kind(kind, options.seed, options.count, temporary)
            rows.append(row)
            print(table([row]).splitlines()[-1], file=sys.stderr, flush=True)
            for outcome, count in distinct(outcomes):
                print(f"  {count} x {outcome.model_dump_json()}", file=sys.stderr, flush=True)
                if options.keep:
                    options.keep.mkdir(parents=True, exist_ok=True)
                    name, data = KINDS[kind].make(Random(f"{options.seed}/{kind}/{outcome.index}"))
                    (options.keep / f"{kind}-{outcome.index}-{Path(name).name}").write_bytes(data)
    print(table(rows))
    if options.json:
        options.json.write_text(json.dumps([row.model_dump() for row in rows], indent=2) + "\n")
    sys.exit(any(row.faults for row in rows))


if __name__ == "__main__":
    main()
