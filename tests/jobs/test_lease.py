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
print(leases.acquire(sys.argv[2]), flush=True)
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


def test_a_lease_has_one_holder_and_is_free_once_it_is_killed(tmp_path: Path) -> None:
    leases = FileLeases(tmp_path)
    with holder(tmp_path, "a") as process:
        assert not leases.acquire("a")
        assert not leases.acquire_from_dead("a")
        assert leases.alive() == 1
        process.kill()
        process.wait()
        assert leases.alive() == 0
        assert leases.acquire_from_dead("a")
    leases.close()


def test_a_holder_that_released_its_lease_counts_as_dead(tmp_path: Path) -> None:
    first, second = FileLeases(tmp_path), FileLeases(tmp_path)
    assert first.acquire("a")
    assert first.renew("a")
    assert not second.renew("a")
    first.release("a")
    assert list(tmp_path.iterdir()) == []
    assert second.acquire_from_dead("a")


def test_counting_leases_changes_none(tmp_path: Path) -> None:
    first, second, observer = FileLeases(tmp_path), FileLeases(tmp_path), FileLeases(tmp_path)
    assert first.acquire("a")
    assert second.acquire("b")
    assert observer.alive() == first.alive() == 2
    assert first.renew("a")
    for leases in (first, second):
        leases.close()
    assert observer.alive() == 0
