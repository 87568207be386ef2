from __future__ import annotations

import pytest

from jobs.job import JobNotFound, JobState, check_id


@pytest.mark.parametrize(
    "job_id", ["", "../../etc/passwd", "019a2b3c4d5e8f0", "019A2B3C4D5E8F01", "019a2b3c4d5e8f01\n"]
)
def test_a_malformed_id_is_an_unknown_job(job_id: str) -> None:
    with pytest.raises(JobNotFound):
        check_id(job_id)


def test_only_queued_and_running_jobs_change_their_state_without_a_request() -> None:
    assert [state for state in JobState if not state.final] == [JobState.QUEUED, JobState.RUNNING]
