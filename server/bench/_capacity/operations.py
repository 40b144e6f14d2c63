"""Counts what a service asks of Redis and of storage, in this process."""

import functools
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import redis.connection

from splatmill.backplane.storage import Storage

_STORAGE = ("head", "get", "put", "put_new", "rename", "entries", "walk", "children", "delete", "download")
"""The methods of storage that make requests by themselves. `stream_get` and `stream_put` are not counted."""


@dataclass
class Operations:
    """What was asked in a block.

    round_trips: number of times that something was sent to Redis; a pipeline is one.
    storage: number of calls by method of storage. A listing counts once, however many pages it has.
    """

    round_trips: int = 0
    storage: Counter[str] = field(default_factory=Counter)


@contextmanager
def counted(storage: Storage) -> Iterator[Operations]:
    """Count what all threads of this process ask of Redis, by synchronous connections, and of this storage."""
    found, lock = Operations(), threading.Lock()
    send = redis.connection.AbstractConnection.send_packed_command

    def counting(self: Any, command: Any, check_health: bool = True) -> Any:
        with lock:
            found.round_trips += 1
        return send(self, command, check_health)  # type: ignore[no-untyped-call]  # redis leaves it untyped

    def wrapped(name: str) -> Callable[..., Any]:
        method = getattr(storage, name)

        @functools.wraps(method)
        def call(*arguments: Any, **named: Any) -> Any:
            with lock:
                found.storage[name] += 1
            return method(*arguments, **named)

        return call

    redis.connection.AbstractConnection.send_packed_command = counting  # type: ignore[method-assign]  # put back below
    for name in _STORAGE:
        setattr(storage, name, wrapped(name))
    try:
        yield found
    finally:
        redis.connection.AbstractConnection.send_packed_command = send  # type: ignore[method-assign]  # as above
        for name in _STORAGE:
            delattr(storage, name)
