"""Events and problems: they survive JSON, a measurement that is no number is absent, and codes have one meaning.

Does not prove the order of states; that is the fold's.
"""

import json
import math
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from splatmill.schema import (
    EVENT,
    FINAL_STATES,
    PROBLEMS,
    Event,
    EventRecord,
    JobPage,
    JobState,
    LogEvent,
    MetricEvent,
    PlanEvent,
    PreviewEvent,
    Problem,
    ProgressEvent,
    Report,
    StateEvent,
    code_for_status,
)

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
COUNTS = st.integers(0, 10**9)
PROBLEM = st.builds(
    Problem.of,
    st.sampled_from(sorted(PROBLEMS)),
    st.text(max_size=40),
    advice=st.none() | st.text(max_size=9),
)

EVENTS = st.one_of(
    st.builds(StateEvent, state=st.sampled_from(JobState), problem=st.none() | PROBLEM),
    st.builds(
        ProgressEvent,
        stage=st.text(max_size=64),
        done=COUNTS,
        total=st.none() | COUNTS,
        step=st.none() | COUNTS,
        loss=st.none() | NUMBERS,
        psnr=st.none() | NUMBERS,
    ),
    st.builds(
        MetricEvent, seconds=st.floats(0, 1e9), step=COUNTS, gaussians=COUNTS, psnr=st.none() | NUMBERS
    ),
    st.builds(LogEvent, message=st.text(max_size=40)),
    st.builds(PreviewEvent, path=st.text(max_size=40), step=st.none() | COUNTS),
    st.builds(
        PlanEvent, plan=st.dictionaries(st.text(max_size=5), st.integers() | st.text(max_size=5), max_size=3)
    ),
)


@given(EVENTS, st.integers(0, 99))
def test_events_survive_the_wire(event: Event, attempt: int):
    record = EventRecord(id="1-0", attempt=attempt, at=datetime.now(UTC), event=event)
    assert EventRecord.model_validate_json(record.model_dump_json(exclude_none=True)) == record
    assert EVENT.validate_json(event.model_dump_json()) == event


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_measurement_that_is_no_number_is_absent(value: float):
    event = ProgressEvent(stage="training", loss=value, psnr=value, eta=value)
    assert (event.loss, event.psnr, event.eta) == (None, None, None)
    json.loads(event.model_dump_json(), parse_constant=pytest.fail)


def test_final_states_are_the_last_three():
    assert list(JobState)[-3:] == [state for state in JobState if state.final]
    assert set(JobState) - FINAL_STATES == {state for state in JobState if not state.final}


def test_times_without_a_zone_are_refused():
    with pytest.raises(ValidationError, match="timezone"):
        EventRecord(id="1", attempt=1, at=datetime(2026, 1, 1), event=LogEvent(message="x"))


@pytest.mark.parametrize("code", sorted(PROBLEMS))
def test_every_code_has_a_status_and_a_title(code: str):
    kind = PROBLEMS[code]
    assert 400 <= kind.status < 600
    assert kind.title[0].isupper()
    assert not kind.title.endswith(".")
    problem = Problem.of(code, "What happened.", facts={"seen": 2}, advice="Do this.")
    assert Problem.model_validate_json(problem.model_dump_json()) == problem
    assert problem.status == kind.status
    assert problem.sentence == "What happened. Do this."


def test_an_unlisted_code_cannot_be_made():
    with pytest.raises(KeyError):
        Problem.of("made_up", "x")


@given(st.integers(400, 599))
def test_every_bare_status_has_a_code_of_its_class(status: int):
    assert PROBLEMS[code_for_status(status)].status // 100 == status // 100


def test_a_report_keeps_what_it_does_not_know():
    row = {"seconds": 1.0, "step": 10, "gaussians": 5, "psnr": 20.0}
    report = Report.model_validate(
        {"curve": [row], "seconds": {"sfm": 1, "train": 2, "evaluate": 3, "export": 4}, "views": [1]}
    )
    assert report.curve[0].psnr == 20
    assert report.model_dump()["views"] == [1]
    assert report.seconds.model_dump()["export"] == 4


def test_a_page_of_jobs_survives_a_state_of_a_later_server() -> None:
    job = {"id": "a", "capture": "b", "options": {}, "created_at": "2026-01-01T00:00:00Z"}
    page = JobPage.model_validate({"jobs": [job | {"state": "paused"}, job | {"state": "queued"}]})
    assert [entry.state.value for entry in page.jobs] == ["paused", "queued"]
    assert not page.jobs[0].state.final
    assert json.loads(page.model_dump_json())["jobs"][0]["state"] == "paused"
    assert "paused" not in list(JobState)
    with pytest.raises(ValidationError):
        JobPage.model_validate({"jobs": [job | {"state": 7}]})
