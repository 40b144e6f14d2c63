"""Storage of captures, checkpoints and models through obstore: a local folder or an S3-compatible bucket.

Every write is atomic: a reader sees the old file, the new one, or none. Paths are those of
`splatmill.backplane.storage.layout`. The synchronous methods are for workers and threads; at most SLOTS of these wait
for a bucket. The asynchronous ones (`stream_*`) let the API pass files through without holding them in memory, and hold
no thread.
"""

import asyncio
import os
import re
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import unquote, urlsplit

import obstore
from obstore.exceptions import AlreadyExistsError
from obstore.store import LocalStore, ObjectStore

from splatmill.backplane.redact import redacted
from splatmill.backplane.storage.bucket import BLOCK, Patience, Resumption, open_bucket
from splatmill.backplane.storage.errors import StorageBusyError, StorageStalledError, storage_errors
from splatmill.backplane.storage.errors import StorageError as StorageError
from splatmill.backplane.storage.errors import StorageFullError as StorageFullError
from splatmill.backplane.storage.slots import NoSlot, Slots
from splatmill.files import replacing

CHUNK = 1 << 20
"""Bytes per piece of a streamed file. A transfer holds a few of them in memory."""

SLOTS = 24
"""Threads of a process that may wait for a bucket. The API has 40, so that 16 are left for what needs no storage."""

_SMALL = 256 * 1024
"""Bytes up to which a file is written with the patience for small requests."""

_CONCURRENT_BLOCKS = 4
_DELETED_AT_ONCE = 1000

OnOperation = Callable[[str, float, StorageError | None], None]
"""Called after each operation with its verb (read, write, list, delete), its seconds, and the error that ended it."""

_STAGED = re.compile(r"#\d+\Z", re.ASCII)


@dataclass(frozen=True)
class Entry:
    """A stored file.

    path: relative to the storage root.
    size: in bytes.
    etag: without quotes.
    modified: time of the last write.
    version: the name that storage itself has for these contents; None where it has none.
    """

    path: str
    size: int
    etag: str
    modified: datetime
    version: str | None = None


class Storage:
    """Files by path under one root.

    `url` is `file:///folder`, the path of a folder (created if missing), or `s3://bucket/prefix` with the usual `AWS_*`
    environment variables. Raises StorageError if it cannot be opened.

    read_only: for a process that only reads, and need not have the right to write to the folder.
    patience: how long a bucket may take.
    on_operation: told of each operation. One that is repeated after a break counts once for each time.
    """

    def __init__(
        self,
        url: str,
        *,
        read_only: bool = False,
        patience: Patience | None = None,
        on_operation: OnOperation | None = None,
    ) -> None:
        self.url = url
        self._on_operation = on_operation
        self.root: Path | None = None
        self._patience = patience or Patience()
        self._slots: Slots | None = None
        self._closed = False
        parts = urlsplit(url)
        if parts.scheme in ("", "file"):
            self.root = Path(unquote(parts.path)).expanduser().absolute()
            _check_folder(self.root, read_only)
            # A folder is removed with its last file, so that a deleted capture leaves no empty folders.
            self.store: ObjectStore = LocalStore(self.root, automatic_cleanup=True)
            self.bulk: ObjectStore = self.store
        elif parts.scheme == "s3":
            self.store, self.bulk = open_bucket(url, self._patience)
            self._slots = Slots(SLOTS, self._patience.slot)
        else:
            raise StorageError(
                f"SPLATMILL_STORAGE={redacted(url)!r} is neither file:///folder nor s3://bucket/prefix; set it to one."
            )

    def close(self) -> None:
        """Refuse all further operations, so that threads which go through storage come to an end.

        Those that are under way end as they would.
        """
        self._closed = True

    @contextmanager
    def _operation(self, verb: str, path: str) -> Iterator[None]:
        """Hold a slot of the bucket, and convert the errors of an operation."""
        if self._slots is None:
            with self._watched(verb, path):
                yield
            return
        try:
            with self._slots.taken(), self._watched(verb, path):
                yield
        except NoSlot:
            refused = StorageBusyError(
                f"Storage does not answer: {self._slots.count} operations wait for it, so it was not asked to {verb} "
                f"{path}. Try again in some seconds."
            )
            self._tell(verb, 0.0, refused)
            raise refused from None

    @contextmanager
    def _watched(self, verb: str, path: str) -> Iterator[None]:
        """Convert the errors of an operation, and tell of its end."""
        if self._closed:
            raise StorageError(f"Storage was closed before it was asked to {verb} {path}: the process ends.")
        began = time.monotonic()
        try:
            with storage_errors(verb, path):
                yield
        except StorageError as error:
            self._tell(verb, time.monotonic() - began, error)
            raise
        except FileNotFoundError:
            self._tell(verb, time.monotonic() - began, None)
            raise
        self._tell(verb, time.monotonic() - began, None)

    def _tell(self, verb: str, seconds: float, error: StorageError | None) -> None:
        if self._on_operation is not None:
            self._on_operation(verb, seconds, error)

    def local_path(self, path: str) -> Path | None:
        """Return the local path of `path`, or None if storage is remote. The file need not exist."""
        return None if self.root is None else self.root / path

    def head(self, path: str) -> Entry | None:
        """Return the entry at `path`, or None if there is none."""
        with self._operation("read", path):
            try:
                return _entry(obstore.head(self.store, path))
            except FileNotFoundError:
                return None

    def exists(self, path: str) -> bool:
        return self.head(path) is not None

    def get(self, path: str, start: int = 0, end: int | None = None) -> bytes:
        """Return the bytes [start, end) of a file, all in memory. Raises FileNotFoundError."""
        with self._operation("read", path):
            if start == 0 and end is None:
                return bytes(obstore.get(self.store, path).bytes())
            stop = end if end is not None else obstore.head(self.store, path)["size"]
            return bytes(obstore.get_range(self.store, path, start=start, end=stop))

    def put(self, path: str, data: bytes | Path) -> None:
        """Store bytes, or a local file, which is streamed, in blocks if it is large. An existing file is replaced."""
        small = isinstance(data, bytes) and len(data) <= _SMALL
        with self._operation("write", path):
            obstore.put(
                self.store if small else self.bulk,
                path,
                data,
                chunk_size=BLOCK,
                max_concurrency=_CONCURRENT_BLOCKS,
            )

    def put_new(self, path: str, data: bytes) -> bool:
        """Store bytes if `path` is free; return False if it is not. Of several writers, at most one succeeds.

        Where a bucket stores the bytes and breaks the connection before its answer, the repetition finds them there:
        the result is then False, and the bytes at `path` are these.
        """
        with self._operation("write", path):
            try:
                obstore.put(self.store if len(data) <= _SMALL else self.bulk, path, data, mode="create")
            except AlreadyExistsError:
                return False
            return True

    async def stream_put(self, path: str, chunks: AsyncIterator[bytes]) -> None:
        """Store the bytes that `chunks` yields. If it raises, nothing is stored and the exception is passed on.

        The file appears once `chunks` has ended. A bucket gets what fits into one block in one request.
        """
        with self._watched("write", path):
            if self.root is None:
                first, ended = await _first_block(chunks)
                if ended:
                    await obstore.put_async(self.bulk, path, first, use_multipart=False)
                    return
                chunks = joined(first, chunks)
            await obstore.put_async(self.bulk, path, chunks, chunk_size=BLOCK, max_concurrency=2)

    async def stream_get(
        self, path: str, start: int = 0, end: int | None = None, version: str | None = None
    ) -> AsyncIterator[bytes]:
        """Yield the bytes [start, end) in pieces of about CHUNK. Raises FileNotFoundError before the first piece, and
        StorageChangedError where the file is no longer of the `version` in its Entry.

        A download that breaks off continues behind the last piece, as long as it makes progress. A reader that is slow
        delays nothing and holds a few pieces in memory.
        """
        reading = Resumption(start, end, self._patience.retries, version)
        while True:
            try:
                with self._watched("read", path):
                    result = await obstore.get_async(self.bulk, path, options=reading.options())
                    reading.begun(result.meta)
                    async for chunk in result.stream(min_chunk_size=CHUNK):
                        reading.received(len(chunk))
                        yield bytes(chunk)
                return
            except StorageError as error:
                pause = reading.pause(error)
            if pause is None:
                return
            await asyncio.sleep(pause)

    def rename(self, source: str, target: str) -> None:
        """Move a file. Raises FileNotFoundError."""
        with self._operation("write", target):
            obstore.rename(self.bulk, source, target)

    def entries(self, prefix: str) -> Iterator[Entry]:
        """Yield all files under the folder `prefix`, sorted by path."""
        with self._operation("list", prefix):
            entries = [_entry(meta) for page in obstore.list(self.store, prefix) for meta in page]
        yield from sorted(entries, key=lambda entry: entry.path)

    def walk(self, prefix: str) -> Iterator[Entry]:
        """Yield all files under the folder `prefix` in any order, page by page, without holding all in memory."""
        pages = iter(obstore.list(self.store, prefix or None))
        while True:
            with self._operation("list", prefix):
                page = next(pages, None)
            if page is None:
                return
            for meta in page:
                yield _entry(meta)

    def children(self, prefix: str) -> list[str]:
        """Return the names of the folders directly under `prefix`, sorted."""
        with self._operation("list", prefix):
            result = obstore.list_with_delimiter(self.store, prefix)
        return sorted(folder.rsplit("/", 1)[-1] for folder in result["common_prefixes"])

    def delete(self, path: str) -> None:
        """Delete a file, if it exists."""
        self._delete([path])

    def delete_prefix(self, prefix: str) -> int:
        """Delete all files under a folder, and return their number."""
        return self._delete([entry.path for entry in self.entries(prefix)])

    def _delete(self, paths: list[str]) -> int:
        """Delete files, if they exist, and return how many were named. A bucket deletes a thousand in a request."""
        if self.root is not None:
            for path in paths:
                with self._operation("delete", path), suppress(FileNotFoundError):
                    obstore.delete(self.store, path)
            return len(paths)
        for start in range(0, len(paths), _DELETED_AT_ONCE):
            some, failures = paths[start : start + _DELETED_AT_ONCE], 0
            while True:
                try:
                    with self._operation("delete", some[0]), suppress(FileNotFoundError):
                        obstore.delete(self.store, some)
                    break
                except StorageStalledError:  # obstore does not know that a deletion may be repeated
                    failures += 1
                    if failures > 1:
                        raise
        return len(paths)

    def delete_stale(self, prefix: str, seconds: float) -> int:
        """Delete the files under a folder that are older than `seconds`, and return their number.

        This includes the files in which the local store stages a write. They are not listed, and a process that is
        killed leaves them behind.
        """
        before = datetime.now(UTC).timestamp() - seconds
        stale = [entry.path for entry in self.entries(prefix) if entry.modified.timestamp() < before]
        self._delete(stale)
        staged = [] if self.root is None else (self.root / prefix).glob("*#*")
        left = [path for path in staged if path.stat().st_mtime < before]
        for file in left:
            file.unlink(missing_ok=True)
        return len(stale) + len(left)

    def delete_unused(self, prefix: str, seconds: float) -> int:
        """Delete all files under a folder if none was written in the last `seconds`, and return their number."""
        before = datetime.now(UTC).timestamp() - seconds
        entries = list(self.entries(prefix))
        if any(entry.modified.timestamp() >= before for entry in entries):
            return 0
        return self._delete([entry.path for entry in entries])

    def delete_staged(self, seconds: float) -> int:
        """Delete the files of all writes that a killed process left unfinished longer ago, and return their number.

        Only a local folder has such files: those in which a write is staged, `name#1`, which are not listed.
        """
        before, deleted = datetime.now(UTC).timestamp() - seconds, 0
        for path in self.root.rglob("*#*") if self.root is not None else ():
            with suppress(FileNotFoundError):
                if _STAGED.search(path.name) and path.is_file() and path.stat().st_mtime < before:
                    path.unlink()
                    deleted += 1
        return deleted

    def download(self, path: str, target: Path) -> None:
        """Copy a stored file to a local path, atomically. Raises FileNotFoundError.

        It continues after a break, as `stream_get` does.
        """
        reading = Resumption(0, None, self._patience.retries)
        with replacing(target) as part, part.open("wb") as file:
            while True:
                try:
                    with self._operation("read", path):
                        result = obstore.get(self.bulk, path, options=reading.options())
                        reading.begun(result.meta)
                        for chunk in result.stream(min_chunk_size=CHUNK):
                            file.write(chunk)
                            reading.received(len(chunk))
                    return
                except StorageError as error:
                    pause = reading.pause(error)
                if pause is None:
                    return
                time.sleep(pause)

    def check(self) -> None:
        """Write and delete a file to test storage. Raises StorageError if that fails."""
        path = f"health/{os.getpid()}"
        self.put(path, b"ok")
        self.delete(path)


def _check_folder(root: Path, read_only: bool) -> None:
    """Create the folder if it is missing. Raise StorageError if it cannot be used."""
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"The storage folder {root} cannot be created: {error}.") from error
    if not os.access(root, os.X_OK | (os.R_OK if read_only else os.W_OK)):
        raise StorageError(
            f"The storage folder {root} is not {'readable' if read_only else 'writable'} by this user; change its "
            "permissions, or set SPLATMILL_STORAGE to another folder."
        )


async def _first_block(chunks: AsyncIterator[bytes]) -> tuple[bytes, bool]:
    """Return the first bytes of a stream, BLOCK or more, or all; and whether these are all."""
    first = bytearray()
    async for chunk in chunks:
        first += chunk
        if len(first) >= BLOCK:
            return bytes(first), False
    return bytes(first), True


async def joined(first: bytes, rest: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """Yield `first`, then what `rest` yields."""
    yield first
    async for chunk in rest:
        yield chunk


def _entry(meta: "obstore.ObjectMeta") -> Entry:
    etag = (meta["e_tag"] or f"{meta['size']:x}-{meta['last_modified'].timestamp()}").removeprefix("W/")
    return Entry(meta["path"], meta["size"], etag.strip('"'), meta["last_modified"], meta["e_tag"])
