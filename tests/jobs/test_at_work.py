from __future__ import annotations

from jobs.at_work import AtWork


def test_an_entry_is_at_work_until_the_last_of_its_runs_ends() -> None:
    at_work = AtWork()
    first, second = at_work.doing("a"), at_work.doing("a")
    with at_work.doing("b"):
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert at_work.ids() == {"a", "b"}
        second.__exit__(None, None, None)
        assert at_work.ids() == {"b"}
    assert at_work.ids() == frozenset()
