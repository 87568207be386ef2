from __future__ import annotations

from jobs.running_work import RunningWork


def test_an_entry_is_running_work_until_the_last_of_its_runs_ends() -> None:
    running_work = RunningWork()
    first, second = running_work.running("a"), running_work.running("a")
    with running_work.running("b"):
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert running_work.ids() == {"a", "b"}
        second.__exit__(None, None, None)
        assert running_work.ids() == {"b"}
    assert running_work.ids() == frozenset()
