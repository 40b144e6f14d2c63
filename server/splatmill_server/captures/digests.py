"""The digests of a capture's files: each claims a name for one upload, and one manifest holds those of all files.

The digest of each file is a file of its own, `captures/{id}/sha256/...`, which is written before the bytes get their
name. The manifest repeats what these say, so that a capture is read at once. It may lack files, or be lost: digests
that it does not hold are read one by one, and put into it. So are all those of a capture from a version without
manifests.
"""

import asyncio
import json
import threading
import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import structlog
from starlette.concurrency import run_in_threadpool

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import FORMAT, check_format, reason, warn
from splatmill.backplane.storage.storage import Entry, Storage, StorageError
from splatmill.schema import Capture, CaptureFile, Role

log = structlog.get_logger()

_CONCURRENT_READS = 32

_REWRITE_SECONDS = 10.0
"""Seconds after which a manifest is written again for files of which this process knows the digests anyway."""

_REMEMBERED = 50_000
"""Digests of new files that a process remembers until they are in manifests; 10 MB."""

CLAIM_SECONDS = 600
"""Seconds for which a digest without a file counts as an upload that is about to end: more than the patience with a
bucket. Until then, other bytes do not get the name."""


class Digests:
    """All operations on digests. Methods raise StorageError."""

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        # By capture, the files that this process has stored and no manifest holds, and when it last wrote a manifest.
        # The time of its creation distinguishes a capture from a deleted one that had its id.
        self._new: OrderedDict[tuple[str, datetime], dict[str, CaptureFile]] = OrderedDict()
        self._written: dict[tuple[str, datetime], float] = {}
        self._lock = threading.Lock()

    def claim(self, capture_id: str, file: CaptureFile) -> bool:
        """Claim the name of a file; return False if another upload has it, or the file is there already.

        The digest is stored with `put_new`, so that exactly one of two concurrent uploads of different bytes gets the
        name. A digest without its file belongs to an upload that is about to end, or was left by a server that died.
        """
        path = layout.capture_digest(capture_id, file.role, file.name)
        if self._storage.put_new(path, file.sha256.encode()):
            return True
        claim = self._storage.head(path)
        if self._storage.exists(layout.capture_file(capture_id, file.role, file.name)):
            return False
        if self.claimed(capture_id, file.role, file.name) != file.sha256:
            if claim is not None and (datetime.now(UTC) - claim.modified).total_seconds() < CLAIM_SECONDS:
                return False
            self._storage.put(path, file.sha256.encode())
        return True

    def remember(self, capture: Capture, file: CaptureFile) -> None:
        """Remember the digest of a file that was just stored, until a manifest holds it."""
        with self._lock:
            self._new.setdefault(_key(capture), {})[f"{file.role.value}/{file.name}"] = file
            self._new.move_to_end(_key(capture))
            while len(self._new) > 1 and sum(map(len, self._new.values())) > _REMEMBERED:
                self._new.popitem(last=False)

    def claimed(self, capture_id: str, role: Role, name: str) -> str | None:
        """Return the digest that a name is claimed for, or None. The file may be missing."""
        try:
            return self._storage.get(layout.capture_digest(capture_id, role, name)).decode()
        except FileNotFoundError:
            return None

    def of(self, capture_id: str, role: Role, name: str) -> str | None:
        """Return the digest of the file with this name, or None if the name is free."""
        digest = self.claimed(capture_id, role, name)
        stored = digest and self._storage.exists(layout.capture_file(capture_id, role, name))
        return digest if stored else None

    async def of_all(self, capture: Capture, entries: Sequence[Entry]) -> list[CaptureFile]:
        """Return the files of a capture with their digests, in the order of `entries`, which are its stored files.

        Left out are files without a digest, which no upload has stored, and those of unknown roles.
        """
        prefix = len(layout.capture_files(capture.id)) + 1
        sizes = {entry.path[prefix:]: entry.size for entry in entries}
        with self._lock:
            new = dict(self._new.get(_key(capture), {}))
        known = await run_in_threadpool(self._manifest, capture, sizes)
        held = len(known)
        known.update((path, file.sha256) for path, file in new.items() if sizes.get(path) == file.size)
        unknown = [path for path in sizes if path not in known and _role_and_name(path) is not None]
        gate = asyncio.Semaphore(_CONCURRENT_READS)

        async def read(path: str) -> None:
            place = _role_and_name(path)
            assert place is not None
            async with gate:
                digest = await run_in_threadpool(self.claimed, capture.id, *place)
            if digest:
                known[path] = digest

        await asyncio.gather(*(read(path) for path in unknown))
        # A manifest that is written at each look at a capture that grows would take quadratic time.
        age = time.monotonic() - self._written.get(_key(capture), float("-inf"))
        if len(known) > held and (unknown or age >= _REWRITE_SECONDS):
            await run_in_threadpool(self._write, capture, known, sizes)
        return [
            file for path in sizes if (file := _described(path, sizes[path], known.get(path))) is not None
        ]

    def _manifest(self, capture: Capture, sizes: Mapping[str, int]) -> dict[str, str]:
        """Return what the manifest says of these files; nothing if there is none, or it is of another capture."""
        try:
            fields = json.loads(self._storage.get(layout.capture_manifest(capture.id)))
            check_format(fields)
            if fields["created_at"] != capture.created_at.isoformat():
                return {}  # of a deleted capture that had this id
            held = ((path, row) for path, row in fields["files"].items() if sizes.get(path) == row[1])
            return {path: str(row[0]) for path, row in held}
        except FileNotFoundError:
            return {}
        except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
            log.warning("a manifest cannot be read and is made anew", capture=capture.id, error=str(error))
            return {}

    def _write(self, capture: Capture, known: Mapping[str, str], sizes: Mapping[str, int]) -> None:
        """Store the manifest. A failure is only logged: nothing depends on it."""
        rows = {path: [digest, sizes[path]] for path, digest in known.items()}
        fields = {"format": FORMAT, "created_at": capture.created_at.isoformat(), "files": rows}
        path = layout.capture_manifest(capture.id)
        try:
            self._storage.put(path, json.dumps(fields, separators=(",", ":")).encode())
            if not self._storage.exists(layout.capture_record(capture.id)):
                self._storage.delete(path)  # the capture was deleted meanwhile
        except StorageError as error:
            log.warning("a manifest cannot be stored", capture=capture.id, error=str(error))
            return
        with self._lock:
            if len(self._written) >= _REMEMBERED:
                self._written.clear()
            self._written[_key(capture)] = time.monotonic()
            new = self._new.pop(_key(capture), {})
            if left := {path: file for path, file in new.items() if path not in known}:
                self._new[_key(capture)] = left


def _key(capture: Capture) -> tuple[str, datetime]:
    return capture.id, capture.created_at


def _described(path: str, size: int, digest: str | None) -> CaptureFile | None:
    """Return a file as clients see it; None for one without a digest, or whose name or digest is not valid."""
    place = _role_and_name(path)
    if place is None or not digest:
        return None
    try:
        return CaptureFile(role=place[0], name=place[1], size=size, sha256=digest)
    except ValueError as error:
        warn(f"{path} is not listed", reason(error))
        return None


def _role_and_name(path: str) -> tuple[Role, str] | None:
    """Return role and name of a path below `files`, or None for a role that this version does not know."""
    role, _, name = path.partition("/")
    return (Role(role), name) if role in Role.__members__ and name else None
