"""Counts what this process asks of Redis and of storage."""

import functools
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import redis.connection

from splatmill.backplane.storage.storage import Storage

_STORAGE = ("head", "get", "put", "put_new", "rename", "entries", "walk", "children", "delete", "download")
"""The methods of storage that make requests by themselves. `stream_get` and `stream_put` are not counted."""


@dataclass
class Operations:
    """What was asked in a block.

    round_trips: number of times that something was sent to Redis; a pipeline is one.
    storage: number of calls by method of storage. A listing counts once, however many pages it has.
    written: bytes that were given to storage.
    """

    round_trips: int = 0
    storage: Counter[str] = field(default_factory=Counter)
    written: int = 0


@contextmanager
def counted() -> Iterator[Operations]:
    """Count what all threads of this process ask of Redis, by synchronous connections, and of any storage."""
    operations, lock = Operations(), threading.Lock()
    send = redis.connection.AbstractConnection.send_packed_command
    methods = {name: getattr(Storage, name) for name in _STORAGE}

    def counting(self: Any, command: Any, check_health: bool = True) -> Any:
        with lock:
            operations.round_trips += 1
        return send(self, command, check_health)  # type: ignore[no-untyped-call]  # redis leaves it untyped

    def wrapped(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def call(self: Storage, *arguments: Any, **named: Any) -> Any:
            with lock:
                operations.storage[name] += 1
                if name in ("put", "put_new"):
                    operations.written += _size(arguments[1])
            return method(self, *arguments, **named)

        return call

    redis.connection.AbstractConnection.send_packed_command = counting  # type: ignore[method-assign]  # put back below
    for name, method in methods.items():
        setattr(Storage, name, wrapped(name, method))
    try:
        yield operations
    finally:
        redis.connection.AbstractConnection.send_packed_command = send  # type: ignore[method-assign]  # as above
        for name, method in methods.items():
            setattr(Storage, name, method)


def _size(data: bytes | Path) -> int:
    return data.stat().st_size if isinstance(data, Path) else len(data)
