"""The plan of a job on disk: an attempt that resumes keeps the plan of the first attempt."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

from splatmill.files import atomic_write
from splatmill.schema import TrainOptions
from splatmill_worker.splat.plan.plan import Plan

FORMAT = 1
"""Version of the file's format. A file without one has version 1; a field with a default does not raise it."""

log = logging.getLogger("splatmill_worker")


def read_plan(path: Path, options: TrainOptions) -> Plan | None:
    """The plan stored for these options; None without one, for other options, or where it is not readable.

    Options that only one of two versions knows are left out of the comparison: one that was added since then must have
    its default. A file that is not readable, or of a later format, is logged.
    """
    if not path.is_file():
        return None
    try:
        stored = json.loads(path.read_text())
        if stored.get("format", 1) > FORMAT:
            raise ValueError(f"it has format {stored['format']}, and this version reads {FORMAT}")
        return Plan.from_dict(stored["plan"]) if _same(stored["options"], options) else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        log.warning(
            "The stored plan cannot be used, so a new one is made and training starts anew: %s: %s",
            path.name,
            error,
        )
        return None


def write_plan(path: Path, options: TrainOptions, plan: Plan) -> None:
    """Store `plan`, and the options that it was made for."""
    document = {
        "format": FORMAT,
        "options": options.model_dump(mode="json"),
        "plan": plan.as_dict(whole=True),
    }
    atomic_write(path, json.dumps(document))


def _same(stored: dict[str, Any], options: TrainOptions) -> bool:
    known = {name: value for name, value in stored.items() if name in TrainOptions.model_fields}
    return TrainOptions.model_validate(known).model_dump() == options.model_dump()
