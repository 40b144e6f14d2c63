"""The marks of records that are being deleted, which keep new jobs from using them (see `deletion`)."""

from collections.abc import Sequence
from typing import cast

import redis

from splatmill.backplane import keys, layout
from splatmill.backplane.storage import Storage
from splatmill.schema import StoredKind, TrainOptions
from splatmill_server.problems import ProblemError
from splatmill_server.space.holdings import Holding

DELETING, DELETED = b"deleting", keys.DELETED
"""Values of a mark: files are being deleted, or they are gone, unless the record was made anew under the same id."""


def needs_of(capture: str, options: TrainOptions) -> list[tuple[StoredKind, str]]:
    """Return what a job on this capture with these options needs: the capture, and a model to start from."""
    start = options.start_model
    return [(StoredKind.capture, capture), *([(StoredKind.model, start)] if start is not None else [])]


def mark_keys(needs: Sequence[tuple[StoredKind, str]]) -> list[str]:
    """Return the keys in Redis of the marks on these records, for a transaction to watch."""
    return [keys.deleting(Holding(kind=kind, id=record_id).key) for kind, record_id in needs]


def check_marks(connection: redis.Redis, storage: Storage, needs: Sequence[tuple[StoredKind, str]]) -> None:
    """Raise a 404 problem if one of these records is being deleted, or was since the request looked for it."""
    values = cast(list[bytes | None], connection.mget(mark_keys(needs)))
    for (kind, record_id), value in zip(needs, values, strict=True):
        is_capture = kind is StoredKind.capture
        path = layout.capture_record(record_id) if is_capture else layout.job_record(record_id)
        if value == DELETING or (value == DELETED and not storage.exists(path)):
            raise ProblemError(
                "capture_not_found" if is_capture else "model_not_found",
                f"The {kind.value} {record_id} is being deleted.",
                advice="Upload the photos again and create a new job."
                if is_capture
                else "Start from another model.",
            )
