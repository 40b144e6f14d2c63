"""Keeps the last decoded photos that are divided, since their faces are loaded one after another, several at a time."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future

from splatmill_worker.images.decode import Pixels

KEPT_BYTES = 2**29
"""Size of the photos that are kept, at most, and of the last one however large it is: five panoramas of 8192 x 4096."""

_kept: OrderedDict[Hashable, Future[Pixels]] = OrderedDict()
_lock = threading.Lock()


def of(key: Hashable, decode: Callable[[], Pixels]) -> Pixels:
    """The pixels that `decode` returned for this key, for the first of several threads that ask for them. Raises as it
    does."""
    with _lock:
        first = key not in _kept
        future = _kept.setdefault(key, Future())
        _kept.move_to_end(key)
    if not first:
        return future.result()
    try:
        future.set_result(decode())
    except BaseException as error:
        future.set_exception(error)
        with _lock:
            _kept.pop(key, None)
        raise
    with _lock:
        done = [each for each in _kept if _kept[each].done()]
        while len(done) > 1 and sum(_kept[each].result().nbytes for each in done) > KEPT_BYTES:
            del _kept[done.pop(0)]
    return future.result()


def forget() -> None:
    """Release all that are kept."""
    with _lock:
        _kept.clear()
