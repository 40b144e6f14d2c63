"""A buffer for the events of an attempt, and the thread that sends them to Redis in order.

Training never waits for Redis, and the events of an outage are sent after it: of one that cannot be reached, and of one
that refuses writes, because its disk or its memory is full. Progress events come faster than clients
can show them: only the newest one is kept, and it is sent every PROGRESS_SECONDS.
"""

import threading
import time
import traceback
from collections import deque

import redis

from splatmill.schema import Event, PlanEvent, ProgressEvent, StateEvent
from splatmill_worker.service.attempts.attempt import Attempt
from splatmill_worker.service.redis_patience import PATIENCE

PROGRESS_SECONDS = 0.25
"""Seconds between two progress events."""

RETRY_SECONDS = 0.5
"""Seconds before an event that Redis did not take is sent again."""

MAX_EVENTS = 2000
"""Number of events that are kept during an outage of Redis. When there are more, the oldest one that is neither a state
nor a plan is dropped."""


class Outbox:
    """Sends events as those of `attempt`, in the order in which they were put. It must be closed.

    trouble: why Redis did not take the last event that was tried; None once it took one.
    """

    def __init__(self, attempt: Attempt) -> None:
        self.trouble: str | None = None
        self._attempt = attempt
        self._changed = threading.Condition()
        self._events: deque[Event] = deque()
        self._progress: ProgressEvent | None = None
        self._sending = False
        self._closed = False
        self._progress_at = 0.0
        self._states: list[StateEvent | PlanEvent] = []
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def put(self, event: Event) -> None:
        """Queue an event to be sent, without waiting."""
        with self._changed:
            if isinstance(event, ProgressEvent):
                self._progress = event
            else:
                if self._progress is not None:
                    # Progress from before a change of state must not appear to come after it.
                    self._events.append(self._progress)
                    self._progress = None
                self._events.append(event)
                self._trim()
            self._changed.notify_all()

    def flush(self, seconds: float = PATIENCE) -> bool:
        """Wait until all events are sent, for at most `seconds`. Return whether they are."""
        with self._changed:
            self._progress_at = 0.0
            self._changed.notify_all()
            return self._changed.wait_for(self._empty, seconds)

    def close(self, seconds: float = PATIENCE) -> bool:
        """Send the remaining events, for at most `seconds`, and end the thread. Return whether all were sent."""
        sent = self.flush(seconds)
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(seconds)
        return sent

    def _empty(self) -> bool:
        return not self._events and self._progress is None and not self._sending

    def _trim(self) -> None:
        if len(self._events) > MAX_EVENTS:
            for index, event in enumerate(self._events):
                if not isinstance(event, StateEvent | PlanEvent):
                    del self._events[index]
                    return

    def _run(self) -> None:
        while (event := self._next()) is not None:
            while not self._sent(event) and not self._closed:
                time.sleep(RETRY_SECONDS)
            with self._changed:
                self._sending = False
                self._changed.notify_all()

    def _next(self) -> Event | None:
        """Wait for the next event that is due and return it; None once the outbox is closed."""
        with self._changed:
            while not self._closed:
                if self._events:
                    self._sending = True
                    return self._events.popleft()
                if self._progress is not None:
                    wait = self._progress_at - time.monotonic()
                    if wait <= 0:
                        event, self._progress = self._progress, None
                        self._progress_at = time.monotonic() + PROGRESS_SECONDS
                        self._sending = True
                        return event
                    self._changed.wait(wait)
                else:
                    self._changed.wait()
            return None

    def _send_states_again(self) -> None:
        """Tell a Redis that has come back empty what this attempt has told before, so that its job is seen to run."""
        if self._states:
            self._attempt.rejoin()
        for told in self._states:
            self._attempt.report(told)

    def _sent(self, event: Event) -> bool:
        """Send an event; return False if Redis did not take it. One that cannot be written at all is given up."""
        try:
            # One round trip: a thousand workers send four thousand events a second.
            if not (self._states and self._attempt.report_if_known(event)):
                self._send_states_again()
                self._attempt.report(event)
            if isinstance(event, StateEvent | PlanEvent):
                self._states.append(event)
        except redis.RedisError as error:
            self.trouble = f"{type(error).__name__}: {error}"
            return False
        except Exception:
            traceback.print_exc()  # the events after it must still be sent
        self.trouble = None
        return True
