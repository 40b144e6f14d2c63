"""What lies in storage, folder by folder, found by listing all of it once."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Entry, Storage
from splatmill.schema import DEFAULT_OWNER, StoredKind
from splatmill_server.base.lists import each

KINDS = {"captures": StoredKind.capture, "jobs": StoredKind.job, "models": StoredKind.model}
"""The kind of record by the name of the folder in storage that holds all records of the kind."""

_FOLDERS = {kind: name for name, kind in KINDS.items()}

_RECORDS = {StoredKind.capture: "capture.json", StoredKind.job: "log.jsonl", StoredKind.model: "job.json"}


class Holding(BaseModel):
    """One folder of storage: a capture, the files of a job, or a model.

    bytes: size of all files but `derived`.
    derived: size of what can be made again: a capture's reconstruction, a job's checkpoints, or a model's conversions
        and orbit videos.
    files: number of files.
    modified: time of the last write of any file, in seconds since 1970; conversions and videos make a model no
        younger, and manifests no capture.
    whole: whether the record is there: `capture.json`, which is written first; `job.json` of a model, which is written
        last; the log of a job that has ended.
    owner: None if nothing says whose it is.
    capture: for a model or a job that has ended, its capture.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    kind: StoredKind
    id: str
    bytes: int = 0
    derived: int = 0
    files: int = 0
    modified: float = 0.0
    whole: bool = False
    owner: str | None = None
    name: str | None = None
    capture: str | None = None

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return self.bytes + self.derived

    @property
    def key(self) -> str:
        """Kind and id, as one text."""
        return f"{self.kind.value}/{self.id}"

    @property
    def folder(self) -> str:
        """The path of the folder."""
        return folder(self.kind, self.id)


@dataclass
class _Sums:
    bytes: int = 0
    derived: int = 0
    files: int = 0
    modified: float = 0.0
    whole: bool = False

    def add(self, entry: Entry, kind: StoredKind, inside: str) -> None:
        derived = layout.is_derived(_FOLDERS[kind], inside)
        if derived:
            self.derived += entry.size
        else:
            self.bytes += entry.size
        self.files += 1
        if not (derived and (kind is StoredKind.model or inside == layout.MANIFEST)):
            self.modified = max(self.modified, entry.modified.timestamp())
        self.whole = self.whole or inside == _RECORDS[kind]


def folder(kind: StoredKind, record_id: str) -> str:
    """Return the path of the folder of a record."""
    match kind:
        case StoredKind.capture:
            return layout.capture(record_id)
        case StoredKind.job:
            return layout.job(record_id)
        case StoredKind.model:
            return layout.model(record_id)


def sums(entries: Iterable[Entry]) -> dict[tuple[StoredKind, str], Holding]:
    """Return the folders that hold these files, by kind and id, without owners."""
    sums_by_record: dict[tuple[StoredKind, str], _Sums] = {}
    for entry in entries:
        if (place := layout.folder_of(entry.path)) is not None:
            kind = KINDS[place[0]]
            sums_by_record.setdefault((kind, place[1]), _Sums()).add(entry, kind, place[2])
    return {
        (kind, record_id): Holding(
            kind=kind,
            id=record_id,
            bytes=held.bytes,
            derived=held.derived,
            files=held.files,
            modified=held.modified,
            whole=held.whole,
        )
        for (kind, record_id), held in sums_by_record.items()
    }


def scan(
    storage: Storage, entries: Iterable[Entry], known: Mapping[str, Holding], job_owners: Mapping[str, str]
) -> list[Holding]:
    """Return all folders in storage with their owners.

    entries: all files in storage.
    known: folders by their keys, as an earlier scan or the row of a job has them. The owner of a record never
    changes, so that records are read once, and those of jobs that have rows never.
    job_owners: the owners of the jobs that have rows, for folders of jobs and of models that are not finished.
    """
    totals = sums(entries)
    whole = [held for held in totals.values() if held.whole]
    unknown = [held for held in whole if not _is_known(held, known)]
    records = each(lambda place: _record(storage, place), [_record_of(held) for held in unknown])
    told = {held.key: _with_facts(held, record) for held, record in zip(unknown, records, strict=True)}
    described = {
        (held.kind, held.id): told.get(held.key) or _as_before(held, known[held.key]) for held in whole
    }
    for (kind, record_id), held in totals.items():
        if (kind, record_id) not in described:
            owner = job_owners.get(record_id) if kind is not StoredKind.capture else None
            model = described.get((StoredKind.model, record_id))
            described[kind, record_id] = held.model_copy(
                update={"owner": owner if owner is not None or model is None else model.owner}
            )
    return list(described.values())


def _is_known(held: Holding, known: Mapping[str, Holding]) -> bool:
    return held.key in known and known[held.key].owner is not None


def _record_of(held: Holding) -> str:
    """Return the path of the record in a folder."""
    return f"{held.folder}/{_RECORDS[held.kind]}"


def _as_before(held: Holding, before: Holding) -> Holding:
    """Return a folder with what its record said: owner, name, and the capture of a model."""
    return held.model_copy(update={"owner": before.owner, "name": before.name, "capture": before.capture})


def _with_facts(held: Holding, record: Mapping[str, Any] | None) -> Holding:
    """Return a folder with owner, name and capture of its record; None is a record that cannot be read."""
    if record is None:
        return held
    texts = {name: value for name in ("name", "capture") if isinstance(value := record.get(name), str)}
    owner = record.get("owner", DEFAULT_OWNER)
    return held.model_copy(update={"owner": owner if isinstance(owner, str) else None, **texts})


def _record(storage: Storage, path: str) -> dict[str, Any] | None:
    try:
        text = storage.get(path)
        record = json.loads(text if path.endswith(".json") else text.partition(b"\n")[0])
        record = record.get("job", record)
    except (FileNotFoundError, ValueError, AttributeError):  # deleted meanwhile, or broken
        return None
    return record if isinstance(record, dict) else None
