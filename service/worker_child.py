"""WorkerChild: a worker process beside the service, for use on one machine.

It is restarted when it dies, and stopped with the service.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from types import TracebackType

from jobs.child_process import GRACE_S
from service.settings import Settings

LOG = logging.getLogger(__name__)

RESTART_AFTER_S = 2.0

USAGE = 2  # exit code of a command with wrong arguments


class WorkerChild:
    """A context during which a worker process runs."""

    def __init__(self, settings: Settings, threads: int | None) -> None:
        self._command = [sys.executable, "-m", "jobs.commands", "--exit-with-parent"]
        self._command += ["--data", str(settings.data)]
        # Not as an argument, which every user can read: the URL may contain a password.
        self._environment = {**os.environ, "GRAINGS_DATABASE": settings.database_url}
        if threads is not None:
            self._command += ["--threads", str(threads)]
        self._stopping = threading.Event()
        self._guard = threading.Lock()
        self._process = self._start()
        self._supervisor = threading.Thread(target=self._supervise, name="worker-supervisor")

    def _start(self) -> subprocess.Popen[bytes]:
        # It stops when its standard input ends, so also when this process is killed. In its own session a Ctrl-C in the
        # terminal reaches only this process, which then stops the worker.
        return subprocess.Popen(self._command, stdin=subprocess.PIPE, start_new_session=True, env=self._environment)

    def _supervise(self) -> None:
        while True:
            code = self._process.wait()
            assert self._process.stdin is not None
            self._process.stdin.close()
            if self._stopping.wait(RESTART_AFTER_S):
                return
            with self._guard:
                if self._stopping.is_set():
                    return
                if code == USAGE:
                    LOG.error("the worker refuses its arguments and is not restarted; restart the service with others")
                    return
                LOG.error("the worker ended with code %d and is restarted", code)
                self._process = self._start()

    def __enter__(self) -> WorkerChild:
        self._supervisor.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._guard:
            self._stopping.set()
            self._process.terminate()
        try:
            self._process.wait(GRACE_S + 15.0)
        except subprocess.TimeoutExpired:
            LOG.error("the worker does not stop and is killed")
            self._process.kill()
        self._supervisor.join()
