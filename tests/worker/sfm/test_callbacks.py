"""Proves that progress is reported and cancelling heard while native code runs.

Does not prove that a native call ends when its token is cancelled: COLMAP decides that.
"""

import threading

import pytest

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import Cancelled
from splatmill_worker.sfm.callbacks import watched


def test_the_caller_observes_while_native_code_runs() -> None:
    observed = threading.Event()
    threads: list[threading.Thread] = []

    def call(_: pycolmap.CancellationToken) -> str:
        assert observed.wait(30)
        return "done"

    def observe() -> None:
        threads.append(threading.current_thread())
        observed.set()

    assert watched(call, lambda: False, observe) == "done"
    assert set(threads) == {threading.current_thread()}


def test_native_code_that_is_cancelled_ends() -> None:
    def call(token: pycolmap.CancellationToken) -> None:
        while not token.is_cancelled:
            threading.Event().wait(0.01)

    with pytest.raises(Cancelled):
        watched(call, lambda: True)


def test_errors_of_the_call_and_of_the_observer_are_raised() -> None:
    def broken(_: pycolmap.CancellationToken) -> None:
        raise OSError("the disk is full")

    with pytest.raises(OSError, match="the disk is full"):
        watched(broken, lambda: False)

    def until_cancelled(token: pycolmap.CancellationToken) -> None:
        while not token.is_cancelled:
            threading.Event().wait(0.01)

    def observe() -> None:
        raise KeyError("observer")

    with pytest.raises(KeyError, match="observer"):
        watched(until_cancelled, lambda: False, observe)
