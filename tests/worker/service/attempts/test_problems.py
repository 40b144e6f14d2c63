"""Proves that each error that can end an attempt has a code and advice, and which ones are tried again.

Does not prove that each place raises the right error. The errors of the engine's own tree: tests/worker/test_errors.py.
"""

import errno
import signal
import subprocess
import sys

import pytest
import redis

from splatmill.backplane.storage.storage import StorageError, StorageFullError
from splatmill_worker.errors import SfmFailed
from splatmill_worker.service.attempts.problems import is_transient, problem_of

NO_PARALLAX = SfmFailed(
    "sfm_no_parallax", "The camera only turned.", {"parallax_deg": 0.2}, "Walk around the scene."
)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (NO_PARALLAX, "sfm_no_parallax"),
        (MemoryError(), "out_of_memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "out_of_memory"),
        (OSError(errno.ENOSPC, "No space left on device", "x"), "storage_full"),
        (OSError(errno.EFBIG, "File too large", "x"), "storage_full"),
        (RuntimeError("[database_sqlite.cc:1389] SQLite error: database or disk is full"), "storage_full"),
        (RuntimeError("[database_sqlite.cc:1350] SQLite error: disk I/O error"), "storage_full"),
        (RuntimeError("No registered database factory succeeded."), "storage_full"),
        (PermissionError(errno.EACCES, "Permission denied", "x"), "storage_unwritable"),
        (StorageFullError("Storage is full: could not write x."), "storage_full"),
        (ZeroDivisionError("division by zero"), "internal_error"),
    ],
)
def test_each_failure_has_a_code_and_advice_and_is_final(error: Exception, code: str) -> None:
    problem = problem_of(error)
    assert problem.code == code
    assert problem.advice
    assert not is_transient(error)


def test_a_named_failure_keeps_its_facts() -> None:
    assert problem_of(NO_PARALLAX).facts == {"parallax_deg": 0.2}


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (StorageError("Storage could not read x: connection refused."), "storage_unavailable"),
        (redis.ConnectionError("Connection refused"), "queue_unavailable"),
        (redis.TimeoutError("Timeout reading from socket"), "queue_unavailable"),
    ],
)
def test_an_outage_of_storage_or_redis_is_transient(error: Exception, code: str) -> None:
    assert is_transient(error)
    problem = problem_of(error)
    assert problem.code == code
    assert problem.advice


@pytest.mark.parametrize(
    ("end", "again"), [(f"os.kill(os.getpid(), {signal.SIGKILL:d})", True), ("exit(3)", False)]
)
def test_a_helper_of_a_library_that_a_signal_ends_is_no_fault_of_the_job(end: str, again: bool) -> None:
    """As the compiler that Triton starts: it wraps the error in one of its own."""

    def compiled() -> None:
        try:
            subprocess.run([sys.executable, "-c", f"import os; {end}"], check=True)
        except subprocess.CalledProcessError as error:
            raise RuntimeError("the compiler failed") from error

    with pytest.raises(RuntimeError) as caught:
        compiled()
    assert is_transient(caught.value) is again


def test_an_error_that_is_its_own_cause_is_judged_in_bounded_time() -> None:
    first, second = RuntimeError("first"), RuntimeError("second")
    first.__context__, second.__context__ = second, first
    assert not is_transient(first)
