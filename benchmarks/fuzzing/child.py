"""The bounded process: reads a range of inputs of one kind and reports the outcome of each as a line of JSON.

    python -m fuzzing.child KIND SEED START STOP

Memory is limited from the moment at which everything is imported, and each input has CPU seconds of its own. Whatever
ends the process was the first input without a line.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from random import Random

import OpenImageIO
import torch

from fuzzing.kinds import KINDS, Kind
from fuzzing.rows import Outcome
from graings.errors import MAX_MESSAGE, GraingsError
from service.problems import ServiceError

MEMORY_MB = 3_072  # an image of the greatest size that is read takes 1 GB, and its stored pixels beside
CPU_S = 60.0  # a photograph of the greatest size that is read takes 18
MESSAGE = MAX_MESSAGE + 300  # characters; the parts of a message are limited, and it has several
ROOT = Path(__file__).resolve().parents[2]
# Names that no message may give away; what the input itself contains does not count.
PRIVATE = re.compile(rf'{re.escape(str(ROOT))}|{re.escape(sys.prefix)}|site-packages|Traceback|File "|/proc/|\.py\b')


def main() -> None:
    kind, seed, start, stop = KINDS[sys.argv[1]], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    folder = Path(tempfile.mkdtemp(prefix="graings-fuzz-", dir=os.environ.get("GRAINGS_FUZZ_TMP")))
    warnings.simplefilter("ignore")  # of numpy, about numbers that overflow
    torch.set_num_threads(1)
    OpenImageIO.attribute("threads", 1)
    try:
        reader = kind.open(folder)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_MB * 1_000_000, resource.RLIM_INFINITY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for name, data in kind.valid():
            kind.read(reader, name, data)  # a seed that is refused would test nothing
        for index in range(start, stop):
            rng = Random(f"{seed}/{kind.name}/{index}")
            name, data = kind.make(rng)
            signal.setitimer(signal.ITIMER_PROF, CPU_S)
            began = time.process_time()
            outcome = _outcome(kind, reader, folder, index, name, data)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1_000
            line = {"outcome": outcome.model_dump(), "peak_mb": peak, "seconds": time.process_time() - began}
            print(json.dumps(line), flush=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _outcome(kind: Kind, reader: object, folder: Path, index: int, name: str, data: bytes) -> Outcome:
    try:
        kind.read(reader, name, data)
    except (GraingsError, ServiceError) as error:
        return _refused(kind, folder, index, name, error)
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        ours = [frame for frame in frames if "/graings/" in frame.filename or "/service/" in frame.filename]
        at = (ours or frames)[-1]
        place = f"{Path(at.filename).name}:{at.lineno} {at.line}"
        fault = "too much memory" if isinstance(error, MemoryError) else "another exception"
        return Outcome(
            index=index, seed=name, error=type(error).__name__, fault=fault, message=str(error)[:300], place=place
        )
    return Outcome(index=index, seed=name)


def _refused(kind: Kind, folder: Path, index: int, name: str, error: Exception) -> Outcome:
    message, fault = str(error), None
    shown = message.replace(str(kind.given(folder, name)), name)
    if PRIVATE.search(shown) or str(folder) in shown:
        fault = "a path or stack trace in the message"
    elif not any(part in message for part in kind.named(name)):
        fault = "the message does not name the file"
    elif len(message) > MESSAGE:
        fault = "a message of any length"
    else:
        fault = None if message.replace("\n", "").isprintable() else "a message that cannot be printed"
    return Outcome(
        index=index,
        seed=name,
        error=type(error).__name__,
        fault=fault,
        message=message.encode("utf-8", "backslashreplace").decode()[:300] if fault else "",
        place=re.sub(r"\d+", "#", shown.encode("ascii", "replace").decode()[-60:]) if fault else "",
    )


if __name__ == "__main__":
    main()
