"""Those who look at a job through the API: asks Redis whether there are any, and puts snapshots there for them.

A thread of its own does both, so that training neither waits for Redis nor asks it anything. It asks once a second.
Snapshots are for the moment: when Redis does not take one, it is dropped.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

import redis

from splatmill.backplane import keys
from splatmill.schema import Event, SnapshotEvent
from splatmill_worker.service.attempts.attempt import Attempt

POLL_SECONDS = 1.0
"""Seconds between two questions whether anybody looks."""

KEPT_SECONDS = 60
"""Seconds for which Redis keeps a snapshot."""


class LiveView:
    """Those who look at the job of an attempt. It must be closed.

    emit: called with the event of each snapshot that Redis has taken.
    """

    def __init__(self, attempt: Attempt, emit: Callable[[Event], None]) -> None:
        self._attempt, self._emit = attempt, emit
        self._there = False
        self._changed = threading.Condition()
        self._pending: tuple[bytes, SnapshotEvent] | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="live view", daemon=True)
        self._thread.start()

    def are_there(self) -> bool:
        """Whether anybody looked when Redis was last asked."""
        return self._there

    def show(self, ply: bytes, event: SnapshotEvent) -> None:
        """Put a snapshot into Redis soon, in place of one that it has not got yet."""
        with self._changed:
            self._pending = ply, event
            self._changed.notify_all()

    def close(self) -> None:
        """End the thread, without waiting for it."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                if self._pending is None and not self._closed:
                    self._changed.wait(POLL_SECONDS)
                if self._closed:
                    return
                pending, self._pending = self._pending, None
            try:
                if pending is not None:
                    self._store(*pending)
                self._there = bool(self._attempt.connection.exists(keys.watched(self._attempt.job_id)))
            except redis.RedisError:
                self._there = False  # the outbox reports the outage

    def _store(self, ply: bytes, event: SnapshotEvent) -> None:
        key = keys.snapshot(self._attempt.job_id)
        with self._attempt.connection.pipeline() as pipe:
            pipe.hset(key, mapping={"ply": ply, "tag": f"{self._attempt.number}-{event.step}"})
            pipe.expire(key, KEPT_SECONDS)
            pipe.execute()
        self._emit(event)
