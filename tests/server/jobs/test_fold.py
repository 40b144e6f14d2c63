"""The fold under a random walk of everything that row and workers can do, against a plain restatement of its rules.

Not proved here: that the real worker keeps its side (tests/service), and the order in which Redis delivers.
"""

from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatmill.backplane.jobs.events import StoredEvent
from splatmill.backplane.jobs.fold import Fold, fold
from splatmill.backplane.jobs.row import JobRow, Verdict
from splatmill.schema import Job, JobState, PlanEvent, Problem, ProgressEvent, StateEvent, TrainOptions

MOMENT = datetime(2026, 1, 1, tzinfo=UTC)
ROW = JobRow(id="a" * 16, capture="b" * 16, options=TrainOptions(), created_at=MOMENT, queued_at=MOMENT)
WHY = Problem.of("sfm_failed", "It failed.")


def state(number: int, generation: int, attempt: int, name: str) -> StoredEvent:
    problem = WHY if name == "failed" else None
    return StoredEvent(f"{number}-0", generation, attempt, StateEvent(state=JobState(name), problem=problem))


def state_of(stored: StoredEvent) -> JobState:
    assert isinstance(stored.event, StateEvent)
    return stored.event.state


names = st.sampled_from([s.value for s in JobState])
walks = st.lists(st.tuples(st.integers(1, 3), st.integers(1, 4), names), max_size=30)
verdicts = st.none() | st.tuples(st.integers(0, 30), st.sampled_from(["cancelled", "failed"]))


@pytest.mark.slow
@settings(max_examples=500, deadline=None)
@given(
    walks,
    st.integers(1, 3),
    st.one_of(st.none(), st.tuples(st.integers(0, 30), st.sampled_from(["cancelled", "failed"]))),
)
def test_a_random_walk_keeps_every_rule(walk: Any, generation: int, verdict: Any) -> None:
    told = [state(i + 1, *step) for i, step in enumerate(walk)]
    after = verdict[0] if verdict else 0
    given_row = ROW.model_copy(
        update={
            "generation": generation,
            "verdict": Verdict(state=verdict[1], at=MOMENT, after=f"{after}-0") if verdict else None,
        }
    )
    job = fold(given_row, told)
    ours = [s for s in told if s.generation == generation]

    # A worker's `cancelled` is never final, and what was appended after a verdict comes too late.
    counted = [
        s for s in ours if state_of(s) is not JobState.cancelled and (not verdict or s.order <= (after, 0))
    ]
    attempt, current = 0, JobState.queued
    for stored in counted:
        if stored.attempt < attempt or current.final:
            continue
        attempt, current = stored.attempt, state_of(stored)
    assert job.attempt == attempt
    assert job.state is (current if current.final or not verdict else JobState(verdict[1]))
    assert (job.model is not None) == (job.state is JobState.succeeded)
    assert (job.problem is not None) == (job.state is JobState.failed and current is JobState.failed)
    assert (job.finished_at is not None) == job.state.final

    # Final is final: whatever is appended later changes nothing.
    if job.state.final:
        later = [state(100 + i, generation, 9, s.value) for i, s in enumerate(JobState)]
        assert fold(given_row, told + later) == job
    # One event at a time ends where all at once do.
    step = Fold(given_row)
    for stored in told:
        step.apply(stored)
    step.close()
    assert step.job() == job


@settings(deadline=None)
@given(walks)
def test_a_restart_begins_anew(walk: Any) -> None:
    told = [state(i + 1, 1, attempt, name) for i, (_, attempt, name) in enumerate(walk)]
    job = fold(ROW.model_copy(update={"generation": 2}), told)
    assert (job.state, job.attempt, job.problem, job.finished_at) == (JobState.queued, 0, None, None)


def test_progress_of_a_superseded_attempt_is_not_shown() -> None:
    told = [state(1, 1, 1, "training"), state(2, 1, 2, "preparing")]
    old = StoredEvent("3-0", 1, 1, ProgressEvent(stage="training", done=9))
    assert fold(ROW, told, old).progress is None
    new = replace(old, attempt=2)
    progress = fold(ROW, told, new).progress
    assert progress is not None
    assert progress.done == 9


def test_the_plan_and_the_times_are_those_of_the_events() -> None:
    told = [
        state(1_000, 1, 1, "preparing"),
        StoredEvent("2000-0", 1, 1, PlanEvent(plan={"sh": 3})),
        state(3_000, 1, 1, "succeeded"),
    ]
    job: Job = fold(ROW, told)
    assert job.plan == {"sh": 3}
    assert job.started_at == datetime.fromtimestamp(1, UTC)
    assert job.finished_at == datetime.fromtimestamp(3, UTC)
    assert job.model == ROW.id
