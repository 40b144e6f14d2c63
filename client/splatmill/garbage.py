"""Python's garbage collector, kept from what is made once and stays."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Keep the collector from running, as long as a program imports its parts, and leave out of its later rounds what
    there is by then: all of it stays (decisions: import-without-collection).
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
