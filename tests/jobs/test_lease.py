from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jobs.lease import FileLeases

HOLD = """
import sys
from pathlib import Path
from jobs.lease import FileLeases
leases = FileLeases(Path(sys.argv[1]))
print(leases.take(sys.argv[2]), flush=True)
sys.stdin.read()
"""


@contextmanager
def holder(folder: Path, name: str) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds a lease."""
    command = [sys.executable, "-c", HOLD, str(folder), name]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "True\n"
        try:
            yield process
        finally:
            process.kill()


def test_a_lease_has_one_holder_and_is_free_once_that_is_killed(tmp_path: Path) -> None:
    leases = FileLeases(tmp_path)
    with holder(tmp_path, "a") as process:
        assert not leases.take("a")
        assert not leases.take_from_the_dead("a")
        assert leases.alive() == 1
        process.kill()
        process.wait()
        assert leases.alive() == 0
        assert leases.take_from_the_dead("a")
    leases.close()


def test_a_holder_that_left_counts_as_dead(tmp_path: Path) -> None:
    first, second = FileLeases(tmp_path), FileLeases(tmp_path)
    assert first.take("a")
    assert first.keep("a")
    assert not second.keep("a")
    first.release("a")
    assert list(tmp_path.iterdir()) == []
    assert second.take_from_the_dead("a")


def test_looking_who_is_alive_disturbs_nobody(tmp_path: Path) -> None:
    first, second, looker = FileLeases(tmp_path), FileLeases(tmp_path), FileLeases(tmp_path)
    assert first.take("a")
    assert second.take("b")
    assert looker.alive() == first.alive() == 2
    assert first.keep("a")
    for leases in (first, second):
        leases.close()
    assert looker.alive() == 0
