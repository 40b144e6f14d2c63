"""Which failures of a unit another attempt may not meet."""

from __future__ import annotations

from splatmill_worker.errors import FailureName, Refusal, SfmFailed, TrainingFailed, WorkerError


def may_pass(error: WorkerError) -> bool:
    """Whether another machine, or this one at another time, may do a unit that ended with this error."""
    if isinstance(error, TrainingFailed):
        return error.name is FailureName.memory
    return error.code in ("backend_unavailable", "decoder_ended") or not isinstance(
        error, Refusal | SfmFailed
    )
