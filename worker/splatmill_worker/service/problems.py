"""What went wrong in an attempt, as a problem a person can act on."""

import errno
import traceback

from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import TimeoutError as RedisTimeoutError

from splatmill.backplane.storage import StorageError, StorageFullError
from splatmill.schema import Problem
from splatmill_worker.errors import WorkerError
from splatmill_worker.service.workspace import FolderInUseError

_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_NO_MEMORY = (
    "can't allocate memory",
    "cannot allocate memory",
    "out of memory",
    "std::bad_alloc",
    "bad allocation",
)

_SMALLER = "Set a smaller image_size, max_gaussians or max_memory, or use a machine with more memory."


class Transient(Exception):
    """Nothing is wrong with the job itself; the same attempt may succeed a little later."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.sentence)
        self.problem = problem


def problem_of(error: BaseException) -> Problem:
    """The problem document for an exception that ended the pipeline.

    Raises Transient for what should be tried again: storage or Redis out of reach, a folder still in use.
    """
    if isinstance(error, WorkerError):
        return Problem.of(error.code, error.message, facts=error.facts, advice=error.advice)
    if isinstance(error, StorageFullError):
        return Problem.of("storage_full", str(error), advice="Make room, then restart the job.")
    if isinstance(error, StorageError):
        raise Transient(
            Problem.of("storage_unavailable", str(error), advice="Check the storage, then restart the job.")
        )
    if isinstance(error, RedisConnectionError | RedisTimeoutError):
        advice = "Check Redis, then restart the job."
        raise Transient(
            Problem.of("queue_unavailable", f"Redis could not be reached: {error}.", advice=advice)
        )
    if isinstance(error, FolderInUseError):
        advice = "Look for a process that was left over on the worker's machine, then restart the job."
        raise Transient(Problem.of("worker_lost", str(error), advice=advice))
    if isinstance(error, OSError) and error.errno in _NO_ROOM:
        return Problem.of(
            "storage_full",
            f"The disk of the worker is full: {error}.",
            facts={"file": error.filename},
            advice="Make room in the worker's data folder, then restart the job.",
        )
    if isinstance(error, OSError) and error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return Problem.of(
            "storage_unwritable",
            f"The worker may not write where it must: {error}.",
            facts={"file": error.filename},
            advice="Let the worker's user write to its data folder, then restart the job.",
        )
    if isinstance(error, MemoryError) or any(sign in str(error).lower() for sign in _NO_MEMORY):
        return Problem.of(
            "out_of_memory", f"A request for memory was refused: {_text(error)}", advice=_SMALLER
        )
    return Problem.of(
        "internal_error",
        f"The attempt ended with an error it does not know: {_text(error)}",
        facts={"where": _where(error)},
        advice="The job's log holds the whole trace. If the photos are good, please report it.",
    )


def _text(error: BaseException) -> str:
    lines = str(error).strip().splitlines() or ["no message"]
    return f"{type(error).__name__}: {lines[0][:500]}"


def _where(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    return f"{frames[-1].name}, line {frames[-1].lineno}" if frames else "unknown"
