"""The plan of a job on disk: an attempt that resumes keeps the plan of the first attempt."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

from splatmill.files import atomic_write
from splatmill.schema import TrainOptions
from splatmill_worker.splat.plan.plan import Plan


def read_plan(path: Path, options: TrainOptions) -> Plan | None:
    """The plan stored for these options; None without one, or where it is of other options or another version."""
    if not path.is_file():
        return None
    stored = json.loads(path.read_text())
    if stored["options"] != options.model_dump(mode="json"):
        return None
    # A plan of another version has other fields.
    with suppress(KeyError, TypeError):
        return Plan.from_dict(stored["plan"])
    return None


def write_plan(path: Path, options: TrainOptions, plan: Plan) -> None:
    """Store `plan`, and the options that it was made for."""
    document = {"options": options.model_dump(mode="json"), "plan": plan.as_dict(whole=True)}
    atomic_write(path, json.dumps(document))
