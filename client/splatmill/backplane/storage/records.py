"""What all stored records have in common: the version of their format, and what becomes of one that is not readable.

A record is read as far as possible: unknown fields are ignored, fields that are not valid are left out where they have
a default. A record that cannot be read at all is skipped, so that it harms no other. Both are logged, once per record.

FORMAT is raised only for a change under which an earlier version would misunderstand a record. New fields with a
default and new types of events do not raise it.
"""

import functools
import json
import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BaseModel, ValidationError

if TYPE_CHECKING:
    from splatmill.backplane.storage.storage import Storage

Model = TypeVar("Model", bound=BaseModel)

FORMAT = 1
"""Version of the format of job rows, events, `job.json` and `capture.json`. A record without one has version 1."""

log = logging.getLogger("splatmill.records")


class UnreadableRecord(ValueError):
    """A stored record that this version cannot read. The message names it and says why."""


def check_format(record: Mapping[str, Any]) -> None:
    """Raise ValueError if a record has a later format than this version reads."""
    version = int(record.get("format", FORMAT))
    if version > FORMAT:
        raise ValueError(f"it has format {version}, and this version reads formats up to {FORMAT}")


def reason(error: Exception) -> str:
    """Return why a record is not readable, in one line."""
    if isinstance(error, KeyError):
        return f"it has no field {error.args[0]!r}"
    return " ".join(str(error).split())[:300]


def read_record(
    storage: "Storage", path: str, model: type[Model], outcome: str = "cannot be read"
) -> Model | None:
    """Return a stored record, or None for one that is missing, or not readable in every part. Raises StorageError.

    outcome: what the log says of a record that is not readable, before the reason.
    """
    try:
        record = json.loads(storage.get(path))
        check_format(record)
        return model.model_validate(record)
    except FileNotFoundError:
        return None
    except ValidationError as error:
        # Without the values: some are secret.
        faults = error.errors(include_url=False, include_context=False, include_input=False)
        why = "; ".join(f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in faults)[:300]
    except (ValueError, TypeError, AttributeError) as error:
        why = reason(error)
    warn(path, f"{outcome}: {why}")
    return None


@functools.lru_cache(maxsize=4096)
def warn(record: str, text: str) -> None:
    """Log that a record, or a part of it, is not readable. The same warning is not repeated."""
    log.warning("%s: %s", record, text)
