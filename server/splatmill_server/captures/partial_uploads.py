"""Files of a capture that arrive in several requests, and can be continued after a break.

This is the part of the IETF draft "Resumable Uploads for HTTP" that a client needs which knows its files: creation,
offset, append and cancellation. Not offered are interim responses (status 104), which uvicorn cannot send.

An upload is known by what it will be: with a digest and a length, the same file of the same capture is the same upload,
also for a client that has forgotten its address. The bytes are held by `splatmill.backplane.storage.parts`.
"""

import asyncio
import hashlib
import json
import secrets
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from weakref import WeakValueDictionary

import structlog
from starlette.concurrency import run_in_threadpool

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.parts import EndMoved, Part, open_part
from splatmill.backplane.storage.records import FORMAT
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import CaptureFile, Response, Role, Time
from splatmill.schema.resources.uploads import UPLOAD_COMPLETE, UPLOAD_OFFSET, write_boolean
from splatmill_server.base.problems import ProblemError, problem_of_storage
from splatmill_server.captures.records import (
    STALE_SECONDS,
    Captures,
    check_whole,
    name_taken,
    sent_name,
    too_large,
)
from splatmill_server.captures.unfinished_uploads import UnfinishedUploads

log = structlog.get_logger()

_Key = tuple[str, str]
"""Ids of a capture and of an upload. The id of an upload alone is the same in every capture that gets the same file."""


class UploadRecord(Response):
    """What an upload will be. `stored` is the file that it became, once it is complete."""

    format: int = FORMAT
    id: str
    role: Role
    name: str
    length: int | None = None
    sha256: str | None = None
    created_at: Time
    stored: CaptureFile | None = None

    @property
    def path(self) -> str:
        """The file that the upload will be, as errors name it."""
        return f"{self.role.value}/{self.name}"


@dataclass(frozen=True)
class Standing:
    """How far an upload is: its record, the bytes held, and seconds until it is deleted if nobody continues it."""

    record: UploadRecord
    offset: int
    seconds_left: int


class PartialUploads:
    """All operations on uploads in several requests. Methods raise ProblemError with the name of the file."""

    def __init__(self, storage: Storage, captures: Captures) -> None:
        self.storage = storage
        self.captures = captures
        # Per upload, a lock around each block, and the request that may append. A later request takes over, since a
        # client that comes back has given up its earlier request, which may hang in a dead connection. Other processes
        # are held off by `Part.append`.
        self._locks: WeakValueDictionary[_Key, asyncio.Lock] = WeakValueDictionary()
        self._writers: dict[_Key, object] = {}
        self._unfinished = UnfinishedUploads(storage)

    async def create(
        self, capture_id: str, role: Role, name: str, length: int | None, sha256: str | None
    ) -> Standing | CaptureFile:
        """Begin an upload, or find the same one; return the stored file if the capture already holds these bytes.

        Raises UnsafeName, and problems for a name that other bytes have (409), a file that is too large (413), and
        storage without room for it (507).
        """
        name = sent_name(name)
        sha256 = sha256.strip().lower() if sha256 is not None else None
        async with _named(f"{role.value}/{name}"):
            return await run_in_threadpool(self._create, capture_id, role, name, length, sha256)

    def _create(
        self, capture_id: str, role: Role, name: str, length: int | None, sha256: str | None
    ) -> Standing | CaptureFile:
        self.captures.get(capture_id)
        taken = self.captures.digests.of(capture_id, role, name)
        if taken is not None and sha256 is not None:
            if taken != sha256:
                raise name_taken(role, name, taken, sha256)
            entry = self.storage.head(layout.capture_file(capture_id, role, name))
            if entry is not None:
                return CaptureFile(role=role, name=name, size=entry.size, sha256=taken)
        upload_id = _upload_id(role, name, length, sha256)
        part = open_part(self.storage, capture_id, upload_id)
        record = self._record(capture_id, upload_id)
        if record is None or record.stored is not None:  # its file was deleted since
            self.captures.check_room(capture_id, length)
            record = UploadRecord(
                id=upload_id, role=role, name=name, length=length, sha256=sha256, created_at=datetime.now(UTC)
            )
            with self._unfinished.one_more(capture_id, upload_id):
                part.create()
                self._write(capture_id, record)
        return Standing(record, part.offset(), STALE_SECONDS)

    async def standing(self, capture_id: str, upload_id: str) -> Standing:
        """Return how far an upload is, and end requests that still append to it. Raises a 404 problem."""
        record = await run_in_threadpool(self._existing, capture_id, upload_id)
        key = (capture_id, upload_id)
        async with _named(record.path), self._lock(key):
            self._writers.pop(key, None)
            record = await run_in_threadpool(self._existing, capture_id, upload_id)
            return await run_in_threadpool(self._standing, capture_id, record)

    def _standing(self, capture_id: str, record: UploadRecord) -> Standing:
        entries = self.storage.entries(layout.upload(capture_id, record.id))
        newest = max((entry.modified for entry in entries), default=record.created_at)
        left = max(0, STALE_SECONDS - int((datetime.now(UTC) - newest).total_seconds()))
        if record.stored is not None:
            return Standing(record, record.stored.size, left)
        try:
            return Standing(record, open_part(self.storage, capture_id, record.id).offset(), left)
        except FileNotFoundError:
            raise self._gone(capture_id, record.id) from None

    async def append(
        self,
        capture_id: str,
        upload_id: str,
        chunks: AsyncIterator[bytes],
        *,
        offset: int,
        complete: bool,
        length: int | None = None,
        body_size: int | None = None,
    ) -> tuple[Standing, CaptureFile | None, bool]:
        """Append a body at `offset`. Return how far the upload is, its file once it has one, and whether that is new.

        complete: whether the body is the last one.
        length: size of the file, where the client says it.
        body_size: announced size of the body.

        What arrives of a body that breaks off is kept. Raises problems for a wrong offset (409, with the true one), a
        length that differs (400), and all those of an upload in one request.
        """
        record = await run_in_threadpool(self._existing, capture_id, upload_id)
        async with _named(record.path):
            part = open_part(self.storage, capture_id, upload_id)
            me, key = object(), (capture_id, upload_id)
            async with self._lock(key):
                record = await run_in_threadpool(self._existing, capture_id, upload_id)
                held = (await run_in_threadpool(self._standing, capture_id, record)).offset
                if record.stored is not None:
                    raise _completed(record.stored)
                if held != offset:
                    raise _wrong_offset(offset, held)
                record = await run_in_threadpool(
                    self._with_length, capture_id, record, offset, length, body_size, complete
                )
                self._writers[key] = me
            try:
                end = await self._append_all(key, part, chunks, me, offset, record.length)
                if not complete:
                    return Standing(record, end, STALE_SECONDS), None, False
                if record.length is not None and end != record.length:
                    raise _wrong_length(record.length, end, offset=end)
                async with self._lock(key):
                    if self._writers.get(key) is not me:
                        raise _superseded(end)
                    file, new = await self._complete(capture_id, record, part)
                return Standing(record, file.size, STALE_SECONDS), file, new
            except FileNotFoundError:
                raise await run_in_threadpool(self._gone, capture_id, upload_id) from None
            finally:
                if self._writers.get(key) is me:
                    del self._writers[key]
                await run_in_threadpool(self._tidy, capture_id)

    async def cancel(self, capture_id: str, upload_id: str) -> None:
        """Delete an upload and its bytes; a file that it has become stays. Raises a 404 problem."""
        await run_in_threadpool(self._existing, capture_id, upload_id)
        key = (capture_id, upload_id)
        async with self._lock(key):
            self._writers.pop(key, None)
            await run_in_threadpool(self._delete, capture_id, upload_id)

    async def _append_all(
        self,
        key: _Key,
        part: Part,
        chunks: AsyncIterator[bytes],
        me: object,
        end: int,
        length: int | None,
    ) -> int:
        """Append what `chunks` yields, in blocks, and return the new end. What a broken body has brought is kept."""
        limit = self.captures.settings.max_file_bytes
        block = bytearray()

        async def write() -> None:
            nonlocal end
            async with self._lock(key):
                if self._writers.get(key) is not me:
                    block.clear()
                    raise _superseded(end)
                await run_in_threadpool(self.captures.check_disk)
                end = await run_in_threadpool(part.append, end, bytes(block))
            block.clear()

        try:
            try:
                async for chunk in chunks:
                    block += chunk
                    if length is not None and end + len(block) > length:
                        raise _wrong_length(length, end + len(block), offset=end)
                    if end + len(block) > limit:
                        raise too_large(end + len(block), limit)
                    if len(block) >= part.block:
                        await write()
            except ProblemError:
                block.clear()
                raise
            finally:
                if block:
                    await write()
                await run_in_threadpool(part.sync)
        except EndMoved as moved:
            raise _wrong_offset(end, moved.offset) from moved
        return end

    async def _complete(self, capture_id: str, record: UploadRecord, part: Part) -> tuple[CaptureFile, bool]:
        """Check the bytes, and make them a file of the capture."""
        digest, size = await run_in_threadpool(_digest, part)
        try:
            check_whole(digest, size, record.sha256, record.length)
            taken = await run_in_threadpool(self.captures.digests.of, capture_id, record.role, record.name)
            if taken not in (None, digest):
                raise name_taken(record.role, record.name, taken, digest)
            file = CaptureFile(role=record.role, name=record.name, size=size, sha256=digest)
            incoming = layout.capture_incoming(capture_id, secrets.token_hex(8))
            whole = incoming if taken is not None else await part.assemble(incoming)
            try:
                new = await self.captures.adopt(capture_id, file, whole, taken)
            finally:
                if whole == incoming:
                    await run_in_threadpool(self.storage.delete, incoming)
        except ProblemError as error:
            # These bytes will never be a file of the capture.
            await run_in_threadpool(self._delete, capture_id, record.id)
            raise _after_completion(error) from error
        await run_in_threadpool(self._delete, capture_id, record.id)
        await run_in_threadpool(self._write, capture_id, record.model_copy(update={"stored": file}))
        return file, new

    def _with_length(
        self,
        capture_id: str,
        record: UploadRecord,
        offset: int,
        length: int | None,
        body_size: int | None,
        complete: bool,
    ) -> UploadRecord:
        """Return the record with the length that a request says or implies, after a check that there is room for it.

        Raises a 400 problem if the lengths of several requests differ.
        """
        implied = offset + body_size if complete and body_size is not None else None
        for said in (length, implied):
            if said is not None and record.length is not None and said != record.length:
                raise _wrong_length(record.length, said, offset=offset)
            if said is not None and record.length is None:
                record = record.model_copy(update={"length": said})
                self._write(capture_id, record)
        needed = record.length if record.length is not None else offset + (body_size or 0)
        self.captures.check_room(capture_id, needed, offset)
        return record

    def _lock(self, key: _Key) -> asyncio.Lock:
        return self._locks.setdefault(key, asyncio.Lock())

    def _tidy(self, capture_id: str) -> None:
        """Delete what was written into a capture that was deleted meanwhile. Raises its 404 problem."""
        if not self.storage.exists(layout.capture_record(capture_id)):
            self.storage.delete_prefix(layout.capture(capture_id))
            self.captures.get(capture_id)

    def _existing(self, capture_id: str, upload_id: str) -> UploadRecord:
        self.captures.get(capture_id)
        record = self._record(capture_id, upload_id) if layout.is_id(upload_id) else None
        if record is None:
            raise self._gone(capture_id, upload_id)
        return record

    def _gone(self, capture_id: str, upload_id: str) -> ProblemError:
        """Return the problem of an upload that is not there, or not any more: a deletion takes the capture first."""
        try:
            self.captures.get(capture_id)
        except ProblemError as problem:
            return problem
        return ProblemError(
            "upload_not_found",
            f"There is no upload {upload_id[:80]!r}; it may have been cancelled, or left for longer than a day.",
            advice="Begin again with PUT /v1/captures/{id}/{role}/{name} and the header Upload-Complete: ?0.",
        )

    def _record(self, capture_id: str, upload_id: str) -> UploadRecord | None:
        for path in (
            layout.upload_record(capture_id, upload_id),
            layout.upload_stored(capture_id, upload_id),
        ):
            try:
                return UploadRecord.model_validate(json.loads(self.storage.get(path)))
            except (FileNotFoundError, ValueError):
                continue
        return None

    def _write(self, capture_id: str, record: UploadRecord) -> None:
        place = layout.upload_record if record.stored is None else layout.upload_stored
        path = place(capture_id, record.id)
        self.storage.put(path, record.model_dump_json(exclude_none=True).encode())

    def _delete(self, capture_id: str, upload_id: str) -> None:
        """Delete the record first: without it, the bytes belong to no upload, and are swept if this is cut short."""
        self.storage.delete(layout.upload_record(capture_id, upload_id))
        self.storage.delete_prefix(layout.upload(capture_id, upload_id))


def _upload_id(role: Role, name: str, length: int | None, sha256: str | None) -> str:
    """Return the same id for the same file; without a length and a digest, a new one each time."""
    if length is None or sha256 is None:
        return secrets.token_hex(16)
    return hashlib.sha256(f"{role.value}/{name}\n{length}\n{sha256}".encode()).hexdigest()[:32]


def _digest(part: Part) -> tuple[str, int]:
    digest, size = hashlib.sha256(), 0
    for block in part.read():
        digest.update(block)
        size += len(block)
    return digest.hexdigest(), size


@asynccontextmanager
async def _named(file: str) -> AsyncIterator[None]:
    """Let every error of an upload name its file."""
    try:
        yield
    except ProblemError as error:
        raise error.about_file(file) from error
    except StorageError as error:
        log.warning("storage error", error=str(error), file=file)
        original = problem_of_storage(error)
        problem = ProblemError(original.code, original.detail, advice=original.advice, facts=original.facts)
        raise problem.about_file(file) from error


def _wrong_offset(offset: int, held: int) -> ProblemError:
    return ProblemError(
        "upload_offset_differs",
        f"The body begins at byte {offset}, but the server holds {held} bytes.",
        advice=f"Send the file from byte {held} on.",
        facts={"provided-offset": offset, "expected-offset": held},
        headers={UPLOAD_OFFSET: str(held), UPLOAD_COMPLETE: write_boolean(False)},
    )


def _wrong_length(expected: int, length: int, *, offset: int | None = None) -> ProblemError:
    return ProblemError(
        "upload_length_differs",
        f"The file was announced with {expected} bytes; this request would make it {length} bytes long.",
        advice="Begin again with the right Upload-Length, or send the missing bytes.",
        facts={"announced": expected, "seen": length},
        headers={} if offset is None else {UPLOAD_OFFSET: str(offset), UPLOAD_COMPLETE: write_boolean(False)},
    )


def _superseded(held: int) -> ProblemError:
    return ProblemError(
        "upload_offset_differs",
        "A later request continues this upload, so this one has ended.",
        advice="Send one request at a time. HEAD answers how many bytes the server holds.",
        facts={"expected-offset": held},
        headers={UPLOAD_OFFSET: str(held), UPLOAD_COMPLETE: write_boolean(False)},
    )


def _completed(stored: CaptureFile) -> ProblemError:
    return ProblemError(
        "upload_completed",
        "The upload is complete, and its file is stored.",
        advice="Nothing more is needed. GET /v1/captures/{id} lists the file.",
        facts={"sha256": stored.sha256},
        headers={UPLOAD_OFFSET: str(stored.size), UPLOAD_COMPLETE: write_boolean(True)},
    )


def _after_completion(error: ProblemError) -> ProblemError:
    """Return the error with the header that says: all bytes arrived, and going on with the upload will not help."""
    problem = error.problem
    headers = {**(error.headers or {}), UPLOAD_COMPLETE: write_boolean(True)}
    return ProblemError(
        problem.code, problem.detail, advice=problem.advice, facts=problem.facts, headers=headers
    )
