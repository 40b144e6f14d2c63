"""What an attempt has to say, sent in order by a thread of its own.

Training never waits for Redis, and while Redis is away events wait here. Progress comes far more often than
anybody reads it: only the newest is kept, and sent a few times a second.
"""

import threading
import time
from collections import deque

from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import TimeoutError as RedisTimeoutError

from splatmill.schema import Event, PlanEvent, ProgressEvent, StateEvent
from splatmill_worker.service.attempt import Attempt

PROGRESS_SECONDS = 0.25
RETRY_SECONDS = 0.5
LIMIT = 2000
"""Events kept while Redis is away; beyond it the oldest log lines and metrics go. States and plans stay."""


class Outbox:
    """Sends the events put into it as `attempt`, in the order they came. Close it, or use it as a context."""

    def __init__(self, attempt: Attempt) -> None:
        self._attempt = attempt
        self._changed = threading.Condition()
        self._events: deque[Event] = deque()
        self._progress: ProgressEvent | None = None
        self._sending = False
        self._closed = False
        self._progress_at = 0.0
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def put(self, event: Event) -> None:
        """Take an event; returns at once."""
        with self._changed:
            if isinstance(event, ProgressEvent):
                self._progress = event
            else:
                if self._progress is not None:
                    # What was measured before a change of state must not seem to come after it.
                    self._events.append(self._progress)
                    self._progress = None
                self._events.append(event)
                self._trim()
            self._changed.notify_all()

    def flush(self, seconds: float | None = None) -> bool:
        """Wait until everything has been sent, however long Redis is away, or at most `seconds`; False then."""
        with self._changed:
            self._progress_at = 0.0
            self._changed.notify_all()
            return self._changed.wait_for(self._empty, seconds)

    def close(self, seconds: float | None = None) -> None:
        """Send what is left, for at most `seconds`, and end the thread."""
        self.flush(seconds)
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(seconds)

    def _empty(self) -> bool:
        return not self._events and self._progress is None and not self._sending

    def _trim(self) -> None:
        if len(self._events) > LIMIT:
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
        """The next event to send, as soon as there is one that is due; None when closed."""
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

    def _sent(self, event: Event) -> bool:
        try:
            self._attempt.say(event)
        except (RedisConnectionError, RedisTimeoutError):
            return False
        return True
