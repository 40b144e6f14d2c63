"""Turns an error that ended an attempt into the problem document that the user sees."""

import errno
import subprocess
import traceback

from redis.exceptions import RedisError

from splatmill.backplane.storage.storage import StorageError, StorageFullError
from splatmill.schema import Problem
from splatmill_worker.errors import DiskReserveReached, FolderInUse, QuotaReached, WorkerError

_DISK_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_DISK_FULL_MESSAGES = (
    "database or disk is full",
    "disk i/o error",
    "no registered database factory succeeded",
)
"""Parts of the messages of RuntimeErrors by which COLMAP reports that its database could not be written or made."""

_NOT_PERMITTED = {errno.EACCES, errno.EPERM, errno.EROFS}
_OUT_OF_MEMORY = (
    "can't allocate memory",
    "cannot allocate memory",
    "out of memory",
    "std::bad_alloc",
    "bad allocation",
)
"""Parts of the messages by which native libraries report that memory ran out. Their errors have no type of its own."""


def is_transient(error: BaseException) -> bool:
    """Return whether the same attempt may succeed a little later: the cause lies outside of the job."""
    if isinstance(error, StorageError):
        return not isinstance(error, StorageFullError)
    return isinstance(error, RedisError | FolderInUse) or is_decoder_end(error) or _is_program_end(error)


def is_decoder_end(error: BaseException) -> bool:
    """Return whether a decoding process was ended: the next attempt leaves the file out, or finds more memory free."""
    return isinstance(error, WorkerError) and error.code == "decoder_ended"


def _is_program_end(error: BaseException) -> bool:
    """Return whether a program that a library had started, such as a compiler of kernels, was ended by a signal."""
    cause: BaseException | None = error
    visited: set[int] = set()  # an error that is raised anew from one of its consequences is its own cause
    while cause is not None and id(cause) not in visited:
        if isinstance(cause, subprocess.CalledProcessError) and cause.returncode < 0:
            return True
        visited.add(id(cause))
        cause = cause.__cause__ or cause.__context__
    return False


def keeps_progress(error: BaseException) -> bool:
    """Return whether a restart of the job may go on from its checkpoint: the cause lies outside of the training."""
    if isinstance(error, OSError):
        return error.errno in _DISK_FULL | _NOT_PERMITTED
    return (
        is_transient(error)
        or isinstance(error, DiskReserveReached | QuotaReached | StorageError | MemoryError)
        or _mentions(error, _DISK_FULL_MESSAGES)
    )


def problem_of(error: BaseException) -> Problem:
    """Return the problem that describes an error to the user. Every error has one."""
    match error:
        case WorkerError():
            return error.problem()
        case StorageFullError():
            return Problem.of(
                "storage_full", str(error), advice="Free space in the storage, then restart the job."
            )
        case StorageError():
            return Problem.of(
                "storage_unavailable",
                str(error),
                advice="Check that the storage can be reached, then restart the job.",
            )
        case RedisError():
            return Problem.of(
                "queue_unavailable",
                f"Redis could not be reached or refused a command: {error}.",
                advice="Check that Redis is running and takes writes, then restart the job.",
            )
        case OSError() if error.errno in _DISK_FULL:
            return Problem.of(
                "storage_full",
                f"The worker could not write a file, because the disk is full or a limit is reached: {error}.",
                facts={"file": error.filename},
                advice="Free space in the worker's data folder, then restart the job.",
            )
        case OSError() if error.errno in _NOT_PERMITTED:
            return Problem.of(
                "storage_unwritable",
                f"The worker was not permitted to read or write a file: {error}.",
                facts={"file": error.filename},
                advice="Give the worker's user write access to its data folder, then restart the job.",
            )
    if _mentions(error, _DISK_FULL_MESSAGES):
        return Problem.of(
            "storage_full",
            f"The worker could not write COLMAP's database, most likely because the disk is full: {_first_line(error)}",
            advice="Free space in the worker's data folder, then restart the job.",
        )
    if isinstance(error, MemoryError) or _mentions(error, _OUT_OF_MEMORY):
        return Problem.of(
            "out_of_memory",
            f"The worker ran out of memory: {_first_line(error)}",
            advice="Set a smaller image_size, max_gaussians or max_memory, or use a machine with more memory.",
        )
    return Problem.of(
        "internal_error",
        f"The job ended with an unexpected error: {_first_line(error)}",
        facts={"where": _where(error)},
        advice="Look for the cause in the job's log, which contains the traceback, and please report it.",
    )


def _mentions(error: BaseException, parts: tuple[str, ...]) -> bool:
    return any(part in str(error).lower() for part in parts)


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines() or ["no message"]
    return f"{type(error).__name__}: {lines[0][:500]}"


def _where(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    return f"{frames[-1].name}, line {frames[-1].lineno}" if frames else "unknown"
