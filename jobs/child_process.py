"""ChildProcess: start one process of a job, wait for it, and stop it.

Runs on an event loop; `stop` may be called from any thread.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

GRACE_S = 45.0  # seconds; loading a large capture or evaluating all held-out views cannot be interrupted


@dataclass(frozen=True, slots=True)
class ProcessExit:
    """Exit code of the child, negative for a signal, and its error message if it wrote one."""

    code: int
    message: str | None


class ChildProcess:
    """`python -m` with `arguments`, whose standard error is appended to the file `log`.

    Its priority on the CPU is lowered by `nice` (0 to 19).
    """

    def __init__(self, arguments: Sequence[str], log: Path, *, nice: int = 0, grace_s: float = GRACE_S) -> None:
        self._arguments = arguments
        self._log = log
        self._nice = nice
        self._grace_s = grace_s
        self._loop = asyncio.get_running_loop()
        self._process: asyncio.subprocess.Process | None = None
        self._stopping = False

    @property
    def stopping(self) -> bool:
        """Whether `stop` was called."""
        return self._stopping

    async def run(self) -> ProcessExit:
        """Start the child and wait until it ends. If cancelled, stop the child first."""
        with self._log.open("ab") as log:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", *self._arguments,
                stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=log,
                # A Ctrl-C in the terminal goes to the worker only, which then stops the child.
                start_new_session=True,
            )  # fmt: skip
        _lower_priority(self._process.pid, self._nice)
        if self._stopping:
            self._signal()
        waiting = asyncio.ensure_future(self._wait(self._process))
        try:
            return await asyncio.shield(waiting)
        except asyncio.CancelledError:
            self._stop()
            await waiting
            raise

    def stop(self) -> None:
        """Ask the child to end; it is killed if it has not ended after the grace time."""
        self._loop.call_soon_threadsafe(self._stop)

    def _stop(self) -> None:
        if not self._stopping:
            self._stopping = True
            self._signal()

    def _signal(self) -> None:
        process = self._process
        if process is not None and process.returncode is None:
            process.send_signal(signal.SIGTERM)
            self._loop.call_later(self._grace_s, _kill, process)

    async def _wait(self, process: asyncio.subprocess.Process) -> ProcessExit:
        assert process.stdout is not None  # a pipe, see `run`
        output = await process.stdout.read()
        return ProcessExit(await process.wait(), _message(output))


def _lower_priority(pid: int, nice: int) -> None:
    """Lower the priority of a process that has just been started; threads that it will start inherit it."""
    lowered = min(19, os.getpriority(os.PRIO_PROCESS, 0) + nice)
    with suppress(ProcessLookupError):  # it has ended already
        os.setpriority(os.PRIO_PROCESS, pid, lowered)
    # Desktops schedule each session as a group first, and the child has a session of its own: there only the priority
    # of the group counts against other sessions.
    with suppress(OSError):  # no such groups here
        Path(f"/proc/{pid}/autogroup").write_text(str(lowered))


def _kill(process: asyncio.subprocess.Process) -> None:
    if process.returncode is None:
        process.kill()


def _message(output: bytes) -> str | None:
    """The error in the last line of the child's output; None if it was killed before it could write one."""
    lines = output.decode("utf-8", "replace").strip().splitlines()
    try:
        return str(json.loads(lines[-1])["error"]) if lines else None
    except (ValueError, KeyError, TypeError):
        return None
