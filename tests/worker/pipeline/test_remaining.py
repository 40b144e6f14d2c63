"""Proves that the remaining time of a stage follows from its own pace, where that is even and where it slows down.

Does not prove how even the stages of real captures are.
"""

import pytest

from splatmill.schema import Event, ProgressEvent
from splatmill_worker.pipeline.events import progress_events
from splatmill_worker.pipeline.remaining import StagePace


@pytest.mark.parametrize("exponent", [1.0, 1.6, 2.0])
@pytest.mark.parametrize("at", [20, 100, 300])
def test_time_that_grows_as_a_power_is_forecast_exactly(exponent: float, at: int) -> None:
    pace = StagePace(50.0)
    for done in range(at + 1):
        pace.add(done, 50.0 + 0.1 * done**exponent)
    expected = 0.1 * (464**exponent - at**exponent)
    assert pace.remaining(464) == pytest.approx(expected, rel=1e-6)


def test_a_stage_that_stands_still_is_forecast_to_take_longer() -> None:
    pace = StagePace(0.0)
    for done in range(101):
        pace.add(done, float(done))
    before = pace.remaining(200)
    pace.add(100, 130.0)
    after = pace.remaining(200)
    assert before == pytest.approx(100.0)
    assert after is not None
    assert before is not None
    assert after > before + 30.0


def test_nothing_is_forecast_too_early_at_the_end_or_without_a_total() -> None:
    pace = StagePace(0.0)
    assert pace.remaining(100) is None
    pace.add(1, 60.0)
    assert pace.remaining(100) is None  # of a hundred, one
    pace.add(5, 60.5)
    assert pace.remaining(100) is not None
    assert pace.remaining(0) is None
    pace.add(100, 70.0)
    assert pace.remaining(100) is None


def test_a_stage_that_begins_anew_is_timed_anew() -> None:
    pace = StagePace(0.0)
    for done in range(0, 101, 10):
        pace.add(done, 10.0 * done)
    pace.add(2, 2000.0)
    for done in range(3, 51):
        pace.add(done, 2000.0 + (done - 2))
    assert pace.remaining(98) == pytest.approx(48.0, rel=0.1)


def test_progress_carries_the_seconds_that_are_left(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 10.0, 20.0, 30.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    events: list[Event] = []
    report = progress_events(events.append)
    for done in (0, 10, 20):
        report("matching", done, 40, "pairs matched")
    report("mapping", 2, 40, "")
    reported = [event for event in events if isinstance(event, ProgressEvent)]
    assert [event.eta for event in reported] == [None, 30.0, 20.0, None]
    assert [event.note for event in reported] == ["pairs matched"] * 3 + [None]
