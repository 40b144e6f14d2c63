"""Whether every file in storage is whole: as it was uploaded or recorded, and of a kind that is known."""

import hashlib
import json
import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from _soak.clients import Promise
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Entry, Storage
from splatmill.schema import Role

_ID = r"[0-9a-f]{16}"
_EXPECTED = (
    rf"captures/{_ID}/capture\.json",
    rf"captures/{_ID}/manifest\.json",
    rf"captures/{_ID}/files/(images|masks|poses)/.+",
    rf"captures/{_ID}/sha256/(images|masks|poses)/.+",
    rf"captures/{_ID}/sfm/.+",
    rf"jobs/{_ID}/(log|curve)\.jsonl",
    rf"jobs/{_ID}/cameras\.json",
    rf"models/{_ID}/.+",
)
"""What may be in storage once no job runs: no upload, no mark of work, no checkpoint."""

_STAGED = re.compile(r"#\d+\Z")
"""Name of a file in which a local folder stages a write. A killed process leaves it, and the sweeper deletes it."""


def halves(promises: Iterable[Promise], storage: Storage) -> list[str]:
    """Return a sentence for each file that is not what was uploaded, or not what the model's record says.

    A model that was made without some of its photos is not whole.
    """
    sentences = []
    for promise in promises:
        for name, content in promise.files.items():
            role, _, file = name.partition("/")
            path = layout.capture_file(promise.capture, Role(role), file)
            try:
                if storage.get(path) != content:
                    sentences.append(f"{path} is not what was uploaded")
            except FileNotFoundError:
                sentences.append(f"{path} was uploaded and is missing")
        if promise.state != "succeeded":
            continue
        try:
            record = json.loads(storage.get(layout.job_record(promise.job)))
            cameras = json.loads(storage.get(layout.model_file(promise.job, "cameras.json")))["cameras"]
        except (FileNotFoundError, ValueError) as error:
            sentences.append(f"the record of the model {promise.job} cannot be read: {error}")
            continue
        if len(cameras) != promise.photos:
            sentences.append(f"{promise.job} was made of {len(cameras)} photos, not of {promise.photos}")
        sentences += _not_whole(promise.job, record, storage)
    return sentences


def _not_whole(model: str, record: Mapping[str, Any], storage: Storage) -> list[str]:
    sentences = []
    for name, digest in record["sha256"].items():
        path = layout.model_file(model, name)
        try:
            whole = hashlib.sha256(storage.get(path)).hexdigest() == digest
        except FileNotFoundError:
            whole = False
        if not whole:
            sentences.append(f"{path} is not whole")
    return sentences


def strays(storage: Storage, restartable: Collection[str] = ()) -> list[str]:
    """Return a sentence for each file that nothing explains once no job runs, or that cannot be read.

    restartable: jobs that were cancelled, whose work is kept for a restart.
    """
    sentences = []
    work = tuple(f"{layout.job_work(job)}/" for job in restartable)
    entries = {entry.path: entry for entry in storage.walk("")}
    for path, entry in sorted(entries.items()):
        if path.startswith(work):
            continue
        if not any(re.fullmatch(pattern, path) for pattern in _EXPECTED):
            sentences.append(f"{path} is in storage, where no job runs and nothing is being uploaded")
        elif (fault := _fault(entry, entries, storage)) is not None:
            sentences.append(f"{path} {fault}")
    if storage.root is not None:
        files = [path for path in storage.root.rglob("*") if path.is_file()]
        unlisted = {path.relative_to(storage.root).as_posix() for path in files} - entries.keys()
        sentences += [
            f"{path} is a file that storage does not list"
            for path in sorted(unlisted)
            if not _STAGED.search(path)
        ]
    return sentences


def _fault(entry: Entry, entries: Mapping[str, Entry], storage: Storage) -> str | None:
    """Return what is wrong with a file of a kind that is known, or None."""
    path = entry.path
    if (place := layout.digest_of(path)) is not None:
        capture = path.split("/")[1]
        file = layout.capture_file(capture, Role(place[0]), place[1])
        if file not in entries:
            return "is the digest of a file that is missing"
        if storage.get(path).decode() != hashlib.sha256(storage.get(file)).hexdigest():
            return f"is not the digest of {file}"
    elif path.endswith((".json", ".jsonl")) and "/files/" not in path:
        text = storage.get(path).decode()
        if path.endswith(".jsonl") and text and not text.endswith("\n"):
            return "breaks off in a line"
        try:
            for line in text.splitlines() if path.endswith(".jsonl") else [text]:
                json.loads(line)
        except ValueError as error:
            return f"is no JSON: {error}"
    elif path.startswith("models/"):
        model = path.split("/")[1]
        preview = path == layout.model_file(model, "preview.jpg") and layout.job_log(model) in entries
        if (
            layout.job_record(model) not in entries and not preview
        ):  # a job keeps its preview, however it ends
            return "is a file of a model without a record"
    return None
