"""TrainerChild: the worker's end of one trainer process.

Starts the child, waits for it, stops it. Lives on an event loop; `stop` may be called from any thread. Knows nothing
of queues or of training.
"""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from dataclasses import dataclass

from jobs.store import JobFolder

GRACE_S = 45.0  # loading a large capture or evaluating all held-out views cannot be interrupted


@dataclass(frozen=True, slots=True)
class ProcessExit:
    """How the child ended: its exit code, negative for a signal, and its message if it left one."""

    code: int
    message: str | None


class TrainerChild:
    """One child process training in one job folder."""

    def __init__(self, folder: JobFolder, threads: int, grace_s: float = GRACE_S) -> None:
        self._folder = folder
        self._threads = threads
        self._grace_s = grace_s
        self._loop = asyncio.get_running_loop()
        self._process: asyncio.subprocess.Process | None = None
        self._stopping = False

    @property
    def stopping(self) -> bool:
        """Whether somebody asked this child to stop."""
        return self._stopping

    async def run(self) -> ProcessExit:
        """Start the child and wait for its end. When cancelled, has it write a checkpoint first."""
        with self._folder.log.open("ab") as log:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "jobs.trainer_process", str(self._folder.path), "--threads", str(self._threads),
                stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=log,
                # A Ctrl-C in the worker's terminal is the worker's to pass on.
                start_new_session=True,
            )  # fmt: skip
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
        """Have the child write a checkpoint and end; it is killed when it does not within the grace time."""
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
        assert process.stdout is not None  # asked for above
        said = await process.stdout.read()
        return ProcessExit(await process.wait(), _message(said))


def _kill(process: asyncio.subprocess.Process) -> None:
    if process.returncode is None:
        process.kill()


def _message(said: bytes) -> str | None:
    """The error in the child's last line, if it left one: a child that was killed could not."""
    lines = said.decode("utf-8", "replace").strip().splitlines()
    try:
        return str(json.loads(lines[-1])["error"]) if lines else None
    except (ValueError, KeyError, TypeError):
        return None
