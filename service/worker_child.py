"""WorkerChild: a worker process beside the service, for one machine without further ado.

Started again when it dies, brought to an end with us. Knows nothing of what it does.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from types import TracebackType

from jobs.trainer_child import GRACE_S
from service.settings import Settings

LOG = logging.getLogger(__name__)

RESTART_AFTER_S = 2.0

USAGE = 2  # exit code of a command that was given what it does not take


class WorkerChild:
    """A context in which a worker runs."""

    def __init__(self, settings: Settings, threads: int | None) -> None:
        self._command = [sys.executable, "-m", "jobs.commands", "--exit-with-parent"]
        self._command += ["--data", str(settings.data)]
        # Not as an argument: those of a process are everybody's to read, and a password may be in it.
        self._environment = {**os.environ, "GRAINGS_DATABASE": settings.database_url}
        if threads is not None:
            self._command += ["--threads", str(threads)]
        self._leave = threading.Event()
        self._guard = threading.Lock()
        self._process = self._start()
        self._keeper = threading.Thread(target=self._keep, name="worker-keeper")

    def _start(self) -> subprocess.Popen[bytes]:
        # It ends when its standard input does, so also when we are killed; its own session keeps a Ctrl-C in the
        # terminal ours to pass on.
        return subprocess.Popen(self._command, stdin=subprocess.PIPE, start_new_session=True, env=self._environment)

    def _keep(self) -> None:
        while True:
            code = self._process.wait()
            assert self._process.stdin is not None
            self._process.stdin.close()
            if self._leave.wait(RESTART_AFTER_S):
                return
            with self._guard:
                if self._leave.is_set():
                    return
                if code == USAGE:
                    LOG.error("the worker refuses how it was started; jobs wait until the service is started otherwise")
                    return
                LOG.error("the worker ended with code %d and is started again", code)
                self._process = self._start()

    def __enter__(self) -> WorkerChild:
        self._keeper.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._guard:
            self._leave.set()
            self._process.terminate()
        try:
            self._process.wait(GRACE_S + 15.0)
        except subprocess.TimeoutExpired:
            LOG.error("the worker does not end and is killed")
            self._process.kill()
        self._keeper.join()
