"""Captures: their records and files. The first bytes stored under a name keep it."""

import hashlib
import json
import secrets
import shutil
import time
from collections.abc import AsyncIterator, Callable, Sequence
from datetime import UTC, datetime
from pathlib import PurePosixPath

import redis
import structlog
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import keys, lists
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.bucket import BLOCK
from splatmill.backplane.storage.errors import StorageBusyError
from splatmill.backplane.storage.records import FORMAT, UnreadableRecord, check_format, reason, warn
from splatmill.backplane.storage.storage import Storage, StorageError, StorageFullError
from splatmill.schema import (
    DEFAULT_OWNER,
    BinKind,
    Capture,
    CaptureFile,
    CapturePage,
    Role,
    StoredKind,
    UnsafeName,
    format_bytes,
    may_be_empty,
    safe_name,
)
from splatmill.schema.tolerant import keep_readable
from splatmill_server.access.caller import Caller
from splatmill_server.base.filters import Filter
from splatmill_server.base.lists import Lists, each
from splatmill_server.base.metrics import Metrics
from splatmill_server.base.problems import ProblemError, problem_of_storage
from splatmill_server.base.settings import Settings
from splatmill_server.captures.digests import Digests

log = structlog.get_logger()

_COUNTED_CAPTURES = 1000
_LISTED_TOGETHER = 500

_RECENT_SECONDS = 5.0
"""Seconds for which uploads use a record that was read before. Their end looks whether the capture is still there."""

DISK_STEP = 8 << 20
"""Bytes of a file that arrive between two checks of the room on the disk."""

STALE_SECONDS = 24 * 3600
"""Age at which an unfinished upload counts as abandoned."""

_IDS_OF_KEY = 3
"""Number of ids that the capture of a key may have."""


class Captures:
    """All operations on captures. Captures exist in storage only, independently of Redis."""

    def __init__(self, storage: Storage, settings: Settings, metrics: Metrics, listed: Lists) -> None:
        self.storage = storage
        self.lists = listed
        self.settings = settings
        self.metrics = metrics
        self.unlisted = False
        """Whether a stored capture may be missing from the lists."""
        self.on_delete: list[Callable[[str], None]] = []
        """Called with the id of a capture once its record is deleted."""
        self.digests = Digests(storage)
        self._recent: dict[str, tuple[float, Capture]] = {}
        # Number of files per capture, as last seen: listing the folder at each upload would take quadratic time. The
        # time of its creation distinguishes a capture from one of the same id that another process may have deleted.
        self._counts: dict[tuple[str, datetime], int] = {}

    def create(self, name: str | None = None, *, owner: str, key: str | None = None) -> tuple[Capture, bool]:
        """Create an empty capture; return its record, and whether it is new.

        With a `key` that the owner has used before, the record is that of the same capture. Its id follows from both.
        """
        capture_id = secrets.token_hex(8)
        if key is not None:
            ids = [_id_of_key(owner, key, number) for number in range(_IDS_OF_KEY)]
            for known in ids:
                if self.storage.exists(layout.capture_record(known)):
                    existing = self.get(known)
                    self._list_new(existing)  # whoever made it may have been killed before that
                    return existing, False
            capture_id = next((known for known in ids if not self._is_leftover(known)), capture_id)
        capture = Capture(id=capture_id, name=name, owner=owner, created_at=datetime.now(UTC))
        record = json.dumps(capture.model_dump(mode="json", exclude={"files"}) | {"format": FORMAT}).encode()
        # Listed only once it is stored, so that a refused capture leaves no entry in the lists. Where storage does not
        # tell whether it stored the record, `background.relisting` finds out.
        try:
            made = self.storage.put_new(layout.capture_record(capture.id), record)
        except (StorageFullError, StorageBusyError):
            raise  # nothing was stored
        except StorageError:
            self.unlisted = True
            raise
        if not made:
            capture = self.get(capture_id)
        self._list_new(capture)
        return capture, made

    def _list_new(self, capture: Capture) -> None:
        """List a capture. Captures can be made and filled without Redis: `background.relisting` lists those."""
        try:
            self._list([capture])
        except redis.RedisError as error:
            self.unlisted = True
            log.warning("a capture is not listed yet", capture=capture.id, error=str(error))

    def _is_leftover(self, capture_id: str) -> bool:
        """Return whether there are files without a record: the capture is being deleted, and new files would go too."""
        # The files are looked for first: a record that another request is just making comes with the first file.
        has_files = any(True for _ in self.storage.entries(layout.capture(capture_id)))
        return has_files and not self.storage.exists(layout.capture_record(capture_id))

    def get(self, capture_id: str) -> Capture:
        """Return the record without the files. Raises a 404 problem, and UnreadableRecord."""
        if layout.is_id(capture_id):
            try:
                return _read(self.storage.get(layout.capture_record(capture_id)), capture_id)
            except FileNotFoundError:
                pass
        raise capture_not_found(capture_id)

    def get_recent(self, capture_id: str) -> Capture:
        """Return the record as it was at most some seconds ago. Raises as `get` does.

        Nothing in a record changes; the capture may have been deleted since.
        """
        read_at, capture = self._recent.get(capture_id, (float("-inf"), None))
        if capture is None or time.monotonic() - read_at > _RECENT_SECONDS:
            capture = self.get(capture_id)
            if len(self._recent) >= _COUNTED_CAPTURES:
                self._recent.clear()
            self._recent[capture_id] = time.monotonic(), capture
        return capture

    def check_visible(self, who: Caller, capture_id: str) -> None:
        """Raise a 404 problem if another owner has the capture, but not if there is none."""
        if who.admin:
            return
        try:
            owner = self.get_recent(capture_id).owner
        except UnreadableRecord:
            owner = None
        if not who.may_see(owner):
            raise capture_not_found(capture_id)

    def has_cameras(self, capture_id: str) -> bool:
        """Return whether an earlier job has recovered the cameras of a capture, or a part of them."""
        return next(iter(self.storage.walk(layout.capture_sfm(capture_id))), None) is not None

    async def get_with_files(self, capture_id: str) -> Capture:
        """Return the record with all files and their digests. Raises a 404 problem."""
        capture = await run_in_threadpool(self.get, capture_id)
        folder = layout.capture_files(capture_id)
        entries = await run_in_threadpool(lambda: list(self.storage.entries(folder)))
        return capture.model_copy(update={"files": await self.digests.of_all(capture, entries)})

    def list(self, cursor: str | None, limit: int, only: Filter | None = None) -> CapturePage:
        """Return a page of the captures that `only` admits, newest first. Raises the problems of `Lists.page`."""
        only = only or Filter()

        def read(capture_ids: Sequence[str]) -> dict[str, Capture]:
            captures = self._listed(capture_ids, BinKind.capture)
            return {
                name: capture
                for name, capture in captures.items()
                if only.admits(capture.owner, capture.name)
            }

        names, narrowed = [lists.name("captures", owner=only.owner)], only.name is not None
        captures, following = self.lists.page(names, cursor, limit, read, narrowed=narrowed)
        return CapturePage(captures=captures, cursor=following)

    def _listed(self, capture_ids: Sequence[str], without_bin: BinKind | None = None) -> dict[str, Capture]:
        """Return the records of those of these captures that exist and can be read, by id (see `Lists.records`)."""
        kept = self.lists.records("captures", capture_ids, without_bin)
        missing = [name for name, record in kept.items() if record is None]
        stored = dict(zip(missing, each(self._stored, missing), strict=True))
        self.lists.keep("captures", {name: record for name, record in stored.items() if record is not None})
        captures = {}
        for capture_id, record in (kept | stored).items():
            try:
                if record is not None:  # else it is being made or deleted
                    captures[capture_id] = _read(record, capture_id)
            except UnreadableRecord as error:
                warn(f"capture {capture_id} is not listed", str(error))
        return captures

    def _stored(self, capture_id: str) -> bytes | None:
        try:
            return self.storage.get(layout.capture_record(capture_id))
        except FileNotFoundError:
            return None

    def _list(self, captures: Sequence[Capture]) -> None:
        added = lists.Additions()
        for capture in captures:
            moment = lists.milliseconds(capture.created_at)
            lists.add(added, "captures", capture.id, moment, capture.owner or DEFAULT_OWNER)
        with self.lists.connection.pipeline() as pipe:
            added.send(pipe)
            pipe.execute()

    def unlist(self, capture_id: str, owner: str | None) -> None:
        """Remove a capture from the lists, from that of its owner only if that is known."""
        with self.lists.connection.pipeline() as pipe:
            lists.remove(pipe, "captures", capture_id, owner)
            pipe.hdel(keys.records("captures"), capture_id)
            pipe.execute()

    def list_missing(self, capture_ids: Sequence[str]) -> int:
        """List those of these captures that no list holds, because Redis was away, and return their number."""
        missing = self.lists.missing("captures", capture_ids)
        captures = self._listed(missing)
        self._list(list(captures.values()))
        return len(captures)

    def make_lists(self, succeeded: object = None) -> int:
        """List all captures in storage, and return their number (see `Lists.makers`)."""
        connection = self.lists.connection
        lists.clear(connection, "captures")
        ids = self.storage.children(layout.captures())
        count = 0
        for start in range(0, len(ids), _LISTED_TOGETHER):
            captures = self._listed(ids[start : start + _LISTED_TOGETHER])
            self._list(list(captures.values()))
            for capture_id in self.lists.deleted(StoredKind.capture, list(captures)):
                if not self.storage.exists(layout.capture_record(capture_id)):
                    self.unlist(capture_id, captures[capture_id].owner)
            count += len(captures)
        return count

    def delete(self, capture_id: str) -> None:
        """Delete a capture and its files. The record goes first, so that no incomplete capture is visible."""
        try:
            owner = self.get(capture_id).owner
        except UnreadableRecord:
            owner = None
        self._recent.pop(capture_id, None)
        self.storage.delete(layout.capture_record(capture_id))
        self._recent.pop(capture_id, None)
        for forget in self.on_delete:
            forget(capture_id)
        self.storage.delete_prefix(layout.capture(capture_id))
        self._recent.pop(capture_id, None)
        self.unlist(capture_id, owner)

    def delete_abandoned_uploads(self) -> int:
        """Delete the files of uploads that nobody has gone on with for STALE_SECONDS, and return their number."""
        deleted = 0
        for capture_id in self.storage.children(layout.captures()):
            folder = layout.capture_incoming(capture_id)
            deleted += self.storage.delete_stale(folder, STALE_SECONDS)
            for upload_id in self.storage.children(layout.capture_uploads(capture_id)):
                deleted += self.storage.delete_unused(layout.upload(capture_id, upload_id), STALE_SECONDS)
        return deleted

    async def save_file(
        self,
        capture_id: str,
        role: Role,
        name: str,
        chunks: AsyncIterator[bytes],
        *,
        announced_sha256: str | None = None,
        announced_size: int | None = None,
    ) -> tuple[CaptureFile, bool]:
        """Store a file while it arrives; return its record, and whether it is new.

        A file that is already stored with the same bytes is not stored again. Raises UnsafeName, and problems for
        other bytes under the name (409), a digest that differs (422), an empty file (422) unless it `may_be_empty`, a
        file that is too large (413), too many files (413) and full storage (507), which all name the file. After an
        error or a lost connection, storage is unchanged.
        """
        name = sent_name(name)
        try:
            return await self._save_file(capture_id, role, name, chunks, announced_sha256, announced_size)
        except ProblemError as error:
            raise error.about_file(f"{role.value}/{name}") from error
        except StorageError as error:
            other = await run_in_threadpool(self._in_the_way, capture_id, role, name)
            if other is not None:
                raise ProblemError(
                    "name_taken",
                    f"{role.value}/{name}: the capture holds {role.value}/{other}, and a name cannot be that of a file "
                    "and of a folder.",
                    advice="Upload this file under another name.",
                    facts={"file": f"{role.value}/{name}", "stored": f"{role.value}/{other}"},
                ) from error
            problem = problem_of_storage(error)
            log.warning("storage error", error=str(error), file=f"{role.value}/{name}", capture=capture_id)
            named = ProblemError(problem.code, problem.detail, advice=problem.advice, facts=problem.facts)
            raise named.about_file(f"{role.value}/{name}") from error

    async def _save_file(
        self,
        capture_id: str,
        role: Role,
        name: str,
        chunks: AsyncIterator[bytes],
        announced_sha256: str | None,
        announced_size: int | None,
    ) -> tuple[CaptureFile, bool]:
        await run_in_threadpool(self.check_room, capture_id, announced_size)
        taken = None
        if announced_size is None or announced_size > BLOCK:
            # A smaller body is read before storage gets any of it, and then finds out whether its name is free.
            taken = await run_in_threadpool(self.digests.of, capture_id, role, name)
        body = _Counted(chunks, self.settings.max_file_bytes, self.check_disk)
        empty_allowed = may_be_empty(role, name)

        def checked() -> CaptureFile:
            digest = body.digest.hexdigest()
            check_whole(digest, body.size, announced_sha256, announced_size, empty_allowed)
            return CaptureFile(role=role, name=name, size=body.size, sha256=digest)

        if taken is not None:
            async for _ in body:
                pass
            return self._same(checked(), taken), False

        async def claimed() -> AsyncIterator[bytes]:
            """Pass the bytes on, and claim the name once they are whole: storage shows the file after that."""
            async for chunk in body:
                yield chunk
            if not await run_in_threadpool(self.digests.claim, capture_id, checked()):
                raise _NameClaimed

        target = layout.capture_file(capture_id, role, name)
        try:
            if await body.begin():
                await self.storage.stream_put(target, claimed())
            else:
                async for _ in claimed():
                    pass
                await run_in_threadpool(self.storage.put, target, b"")
        except _NameClaimed:
            taken = await run_in_threadpool(self.digests.claimed, capture_id, role, name)
            return self._same(checked(), taken), False
        file = checked()
        await run_in_threadpool(self._arrived, capture_id, file)
        return file, True

    def _same(self, file: CaptureFile, taken: str | None) -> CaptureFile:
        """Return a file whose name is taken by the same bytes. Raises a 409 problem for other bytes."""
        if taken != file.sha256:
            raise name_taken(file.role, file.name, taken, file.sha256)
        return file

    async def adopt(self, capture_id: str, file: CaptureFile, incoming: str, taken: str | None) -> bool:
        """Give the bytes at `incoming` their name; return False if the same bytes already have it.

        `taken` is the digest of the file that had the name before, or None. Raises a 409 problem for other bytes.
        """
        if taken is None and await run_in_threadpool(self.digests.claim, capture_id, file):
            target = layout.capture_file(capture_id, file.role, file.name)
            await run_in_threadpool(self.storage.rename, incoming, target)
            await run_in_threadpool(self._arrived, capture_id, file)
            return True
        self._same(file, await run_in_threadpool(self.digests.claimed, capture_id, file.role, file.name))
        return False

    def _arrived(self, capture_id: str, file: CaptureFile) -> None:
        """Count a new file, unless the capture was deleted during the upload: then delete the file, too."""
        if not self.storage.exists(layout.capture_record(capture_id)):
            self._recent.pop(capture_id, None)
            self.storage.delete_prefix(layout.capture(capture_id))
            raise capture_not_found(capture_id)
        capture = self.get_recent(capture_id)
        self.digests.remember(capture, file)
        self.metrics.uploaded.inc(file.size)
        self.metrics.files.inc()
        counted = (capture_id, capture.created_at)
        self._counts[counted] = self._counts.get(counted, 0) + 1

    def _in_the_way(self, capture_id: str, role: Role, name: str) -> str | None:
        """Return the name of a stored file that lies above `name` in the folders, or below it."""
        for folder in PurePosixPath(name).parents[:-1]:
            if self.storage.exists(layout.capture_file(capture_id, role, folder.as_posix())):
                return folder.as_posix()
        root = layout.capture_files(capture_id, role)
        below = next(iter(self.storage.entries(layout.capture_file(capture_id, role, name))), None)
        return None if below is None else below.path[len(root) + 1 :]

    def check_room(self, capture_id: str, announced_size: int | None, held: int = 0) -> None:
        """Raise a problem if the capture does not exist (404), is full (413), or cannot take a file of this size.

        A file may be larger than the limit (413), or than what the disk has left (507). `held` is the number of its
        bytes that are stored already.
        """
        counted = (capture_id, self.get_recent(capture_id).created_at)
        limit = self.settings.max_files_per_capture
        if counted not in self._counts:
            if len(self._counts) >= _COUNTED_CAPTURES:
                self._counts.clear()
            self._counts[counted] = sum(1 for _ in self.storage.entries(layout.capture_files(capture_id)))
        if self._counts[counted] >= limit:
            raise ProblemError(
                "body_too_large",
                f"The capture already holds {limit} files, and no more are accepted.",
                facts={"limit": limit},
            )
        if announced_size is not None and announced_size > self.settings.max_file_bytes:
            raise too_large(announced_size, self.settings.max_file_bytes)
        self.check_disk(max((announced_size or 0) - held, 0))

    def check_disk(self, size: int = 0) -> None:
        """Raise a 507 problem if the disk has not so many bytes left beyond the reserve.

        It is asked again while a file arrives: of many files at once, each finds the same room before its first byte.
        """
        if self.storage.root is not None:
            free = shutil.disk_usage(self.storage.root).free
            needed = size + self.settings.min_free_bytes
            if free < needed:
                raise ProblemError(
                    "storage_full",
                    f"The disk has {format_bytes(free)} left; this upload needs {format_bytes(needed)}, "
                    "including the reserve that is kept free.",
                    advice="Delete captures or jobs that are no longer needed, or extend the storage.",
                    facts={"free": free, "needed": needed},
                )


class _NameClaimed(Exception):
    """Another file has the name of an upload."""


class _Counted:
    """Passes chunks on, counts and hashes them, and raises a 413 problem above the limit.

    check_disk: raises what keeps more bytes from being stored; called every DISK_STEP bytes.
    """

    def __init__(self, chunks: AsyncIterator[bytes], limit: int, check_disk: Callable[[], None]) -> None:
        self._chunks = chunks
        self._limit = limit
        self._check_disk = check_disk
        self._checked = 0
        self._first: bytes | None = None
        self.size = 0
        self.digest = hashlib.sha256()

    async def begin(self) -> bool:
        """Wait for the first bytes; return False if there are none. Some stores cannot store an empty upload."""
        async for chunk in self._chunks:
            if chunk:
                self._first = chunk
                return True
        return False

    def __aiter__(self) -> "_Counted":
        return self

    async def __anext__(self) -> bytes:
        chunk, self._first = self._first, None
        while not chunk:  # Starlette ends a body with an empty chunk, which storage does not accept.
            chunk = await anext(self._chunks)
        self.size += len(chunk)
        if self.size > self._limit:
            raise too_large(self.size, self._limit)
        if self.size - self._checked >= DISK_STEP:
            self._checked = self.size
            await run_in_threadpool(self._check_disk)
        self.digest.update(chunk)
        return chunk


def _read(record: bytes, capture_id: str) -> Capture:
    try:
        fields = json.loads(record)
        check_format(fields)
        capture, left_out = keep_readable(Capture.model_validate, fields)
    except (ValueError, TypeError, AttributeError) as error:
        raise UnreadableRecord(f"capture.json of {capture_id} cannot be read: {reason(error)}") from error
    if left_out:
        warn(layout.capture_record(capture_id), f"left out what cannot be read: {'; '.join(left_out)[:300]}")
    return capture


def capture_not_found(capture_id: str) -> ProblemError:
    """Return the 404 problem for an id without a capture."""
    return ProblemError(
        "capture_not_found",
        f"There is no capture {capture_id[:80]!r}.",
        advice="List captures with GET /v1/captures, or create one with POST /v1/captures.",
    )


def name_taken(role: Role, name: str, stored: str | None, sent: str) -> ProblemError:
    """Return the problem for a file whose name other bytes have."""
    return ProblemError(
        "name_taken",
        f"The capture already holds {role.value}/{name} with other bytes, which were not replaced.",
        advice="Upload this file under another name.",
        facts={"stored_sha256": stored, "sent_sha256": sent},
    )


def too_large(size: int, limit: int) -> ProblemError:
    return ProblemError(
        "body_too_large",
        f"The file has {format_bytes(size)} or more; at most {format_bytes(limit)} are accepted.",
        advice="Split the file, or raise the server's setting SPLATMILL_MAX_FILE_BYTES.",
        facts={"limit": limit},
    )


def check_whole(
    digest: str,
    size: int,
    announced_sha256: str | None,
    announced_size: int | None,
    empty_allowed: bool = False,
) -> None:
    """Raise a problem if received bytes are not those that were announced (422), too few (400), or none (422)."""
    if announced_size is not None and size != announced_size:
        raise ProblemError(
            "body_cut_off",
            f"Only {size} of {announced_size} bytes arrived; nothing was stored.",
            advice="Send the file again.",
            facts={"received": size, "announced": announced_size},
        )
    if size == 0 and not empty_allowed:
        raise ProblemError("file_empty", "The file has no bytes; nothing was stored.")
    if announced_sha256 is not None and digest != announced_sha256.strip().lower():
        raise ProblemError(
            "digest_mismatch",
            "The SHA-256 of the received bytes differs from the announced one; nothing was stored.",
            advice="Send the file again.",
            facts={"announced": announced_sha256[:100], "received": digest},
        )


def _id_of_key(owner: str, key: str, number: int) -> str:
    """Return one of the ids that the capture of a key may have: the first, unless that is being deleted."""
    return hashlib.sha256(f"{owner}\0{key}\0{number}".encode()).hexdigest()[:32]


def sent_name(name: str) -> str:
    """Return the `safe_name` of a file in a request. Raises UnsafeName, also for a name that was not sent as UTF-8."""
    if "\ufffd" in name:
        raise UnsafeName(
            f"The file name {name[:80]!a} is not UTF-8; rename the file, or encode its name as UTF-8."
        )
    return safe_name(name)


def fingerprints(files: Sequence[CaptureFile]) -> list[str]:
    """Return role, name and digest of each file, sorted; equal for equal sets of files."""
    return sorted(f"{file.role.value}/{file.name} {file.sha256}" for file in files)
