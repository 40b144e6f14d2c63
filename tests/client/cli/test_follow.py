"""Proves that a signal is noticed while the program waits for events, whichever thread the system gave it to, and that
progress which is read after the state that follows it is not shown.

What a first and a second signal do is in test_cli, with real processes.
"""

import signal
import threading
from datetime import UTC, datetime, timedelta
from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any

import pytest

from splatmill.cli.display import follow
from splatmill.schema import Event, EventRecord, JobState, ProgressEvent, StateEvent


def test_a_signal_that_another_thread_receives_is_noticed() -> None:
    """Then the main thread's wait does not end by itself, as when a signal comes just before it begins."""
    inbox: SimpleQueue[follow.Item] = SimpleQueue()
    after = threading.Timer(40 * follow.SIGNAL_SECONDS, lambda: inbox.put(follow.EventsEnded()))
    with follow._signals_into(inbox):
        threading.Timer(0.2, lambda: signal.pthread_kill(threading.get_ident(), signal.SIGINT)).start()
        after.start()
        item = follow._next(inbox)
    after.cancel()
    assert isinstance(item, follow.Interruption)


def test_progress_that_is_read_after_the_next_state_is_not_shown(capsys: pytest.CaptureFixture[str]) -> None:
    begun = datetime(2026, 1, 1, tzinfo=UTC)

    def record(seconds: int, event: Event) -> EventRecord:
        return EventRecord(id=str(seconds), attempt=1, at=begun + timedelta(seconds=seconds), event=event)

    read = [
        record(0, StateEvent(state=JobState.training)),
        record(1, ProgressEvent(stage="training", done=75, total=150)),
        record(3, StateEvent(state=JobState.exporting)),
        record(2, ProgressEvent(stage="training", done=150, total=150)),
        record(4, ProgressEvent(stage="files", done=1, total=2)),
    ]
    job: Any = SimpleNamespace(id="job", events=lambda: iter(read), result=lambda: None)
    follow.follow_job(lambda: job, verbose=False)
    assert capsys.readouterr().out.splitlines() == [
        "training",
        "training  75/150",
        "writing the model",
        "files  1/2",
    ]
