"""A cache in storage of recovered cameras, so that all jobs on a capture share them, on any machine.

`sfm` writes its models to `run/sfm/<photos>/model-<settings>`. These names are digests of the inputs, so that a model
of the same name is the same model. The cache holds the same tree under `captures/{id}/sfm`.
"""

import json
import logging
from pathlib import Path

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Entry, Storage
from splatmill_worker.service import staging
from splatmill_worker.service.room import Room

log = logging.getLogger("splatmill_worker")

_FOLDER = "sfm"
_LAST_FILE = "facts.json"
"""The file of a model that is copied last, to and from storage: a folder without it is incomplete and is not used."""


def fetch(storage: Storage, capture_id: str, run: Path) -> int:
    """Copy the cached models of a capture that the `run` folder lacks into it. Return their number."""
    prefix = layout.capture_sfm(capture_id)
    entries = {entry.path[len(prefix) + 1 :]: entry for entry in storage.entries(prefix)}
    lasts, others = dict[Path, Entry](), dict[Path, Entry]()
    for last in (name for name in entries if name.endswith(f"/{_LAST_FILE}")):
        folder = last.removesuffix(_LAST_FILE)
        if (run / _FOLDER / last).is_file():
            continue
        if not _readable(storage.get(f"{prefix}/{last}")):
            log.warning("The stored cameras %s of this capture are not readable and are not used.", folder)
            storage.delete(f"{prefix}/{last}")  # so that `store` replaces them
            continue
        lasts[run / _FOLDER / last] = entries[last]
        others |= {
            run / _FOLDER / name: entry
            for name, entry in entries.items()
            if name.startswith(folder) and name != last
        }
    staging.fetch(storage, others)
    staging.fetch(storage, lasts)
    return len(lasts)


def _readable(document: bytes) -> bool:
    try:
        return isinstance(json.loads(document), dict)
    except ValueError:
        return False


def store(storage: Storage, capture_id: str, run: Path, room: Room) -> int:
    """Copy the models of the `run` folder that the cache lacks into it. Return their number.

    Raises StorageError, QuotaReached where there is no room for one, and redis.RedisError.
    """
    prefix = layout.capture_sfm(capture_id)
    stored = 0
    for last in sorted((run / _FOLDER).glob(f"*/model-*/{_LAST_FILE}")):
        target = f"{prefix}/{last.parent.relative_to(run / _FOLDER).as_posix()}"
        if storage.exists(f"{target}/{_LAST_FILE}"):
            continue
        paths = [*(p for p in sorted(last.parent.iterdir()) if p.is_file() and p != last), last]
        with room.of_capture(capture_id, sum(path.stat().st_size for path in paths)):
            for path in paths:
                storage.put(f"{target}/{path.name}", path)
        stored += 1
    return stored
