"""Storage of captures, checkpoints and models through obstore: a local folder or an S3-compatible bucket.

Every write is atomic: a reader sees the old file, the new one, or none. Paths are those of
`splatmill.backplane.layout`. The synchronous methods are for workers and threads. The asynchronous ones (`stream_*`)
let the API pass files through without holding them in memory.
"""

import os
import re
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError
from obstore.store import LocalStore, ObjectStore, from_url

from splatmill.backplane.redact import redacted
from splatmill.files import replacing

if TYPE_CHECKING:  # These names exist in its stubs alone.
    from obstore.store import ClientConfig, RetryConfig

CHUNK = 1 << 20
"""Bytes per piece of a streamed file. A transfer holds a few of them in memory."""

_S3_RETRY: "RetryConfig" = {"max_retries": 4, "retry_timeout": timedelta(seconds=20)}
"""By default, obstore retries for three minutes, which is longer than a client of the API waits."""

_FULL = ("os error 28", "os error 122", "os error 27", "No space left", "QuotaExceeded", "StorageFull")


_STAGED = re.compile(r"#\d+\Z", re.ASCII)


class StorageError(Exception):
    """Storage cannot be read or written. The message says what was tried, and the reason."""


class StorageFullError(StorageError):
    """Storage is full (disk, quota or file size limit). Nothing was stored."""


@dataclass(frozen=True)
class Entry:
    """A stored file.

    path: relative to the storage root.
    size: in bytes.
    etag: without quotes.
    modified: time of the last write.
    """

    path: str
    size: int
    etag: str
    modified: datetime


class Storage:
    """Files by path under one root.

    `url` is `file:///folder`, the path of a folder (created if missing), or `s3://bucket/prefix` with the usual `AWS_*`
    environment variables. Raises StorageError if it cannot be opened.

    read_only: for a process that only reads, and need not have the right to write to the folder.
    """

    def __init__(self, url: str, *, read_only: bool = False) -> None:
        self.url = url
        self.root: Path | None = None
        parts = urlsplit(url)
        if parts.scheme in ("", "file"):
            self.root = Path(unquote(parts.path)).expanduser().absolute()
            _check_folder(self.root, read_only)
            # A folder is removed with its last file, so that a deleted capture leaves no empty folders.
            self.store: ObjectStore = LocalStore(self.root, automatic_cleanup=True)
        elif parts.scheme == "s3":
            self.store = from_url(url, client_options=_s3_client(), retry_config=_S3_RETRY)
        else:
            raise StorageError(
                f"SPLATMILL_STORAGE={redacted(url)!r} is neither file:///folder nor s3://bucket/prefix; set it to one."
            )

    def local_path(self, path: str) -> Path | None:
        """Return the local path of `path`, or None if storage is remote. The file need not exist."""
        return None if self.root is None else self.root / path

    def head(self, path: str) -> Entry | None:
        """Return the entry at `path`, or None if there is none."""
        with storage_errors("read", path):
            try:
                return _entry(obstore.head(self.store, path))
            except FileNotFoundError:
                return None

    def exists(self, path: str) -> bool:
        return self.head(path) is not None

    def get(self, path: str, start: int = 0, end: int | None = None) -> bytes:
        """Return the bytes [start, end) of a file, all in memory. Raises FileNotFoundError."""
        with storage_errors("read", path):
            if start == 0 and end is None:
                return bytes(obstore.get(self.store, path).bytes())
            stop = end if end is not None else obstore.head(self.store, path)["size"]
            return bytes(obstore.get_range(self.store, path, start=start, end=stop))

    def put(self, path: str, data: bytes | Path) -> None:
        """Store bytes, or a local file, which is streamed. An existing file is replaced."""
        with storage_errors("write", path):
            obstore.put(self.store, path, data)

    def put_new(self, path: str, data: bytes) -> bool:
        """Store bytes if `path` is free; return False if it is not. Of several writers, exactly one succeeds."""
        with storage_errors("write", path):
            try:
                obstore.put(self.store, path, data, mode="create")
            except AlreadyExistsError:
                return False
            return True

    async def stream_put(self, path: str, chunks: AsyncIterator[bytes]) -> None:
        """Store the bytes that `chunks` yields. If it raises, nothing is stored and the exception is passed on."""
        with storage_errors("write", path):
            await obstore.put_async(self.store, path, chunks, chunk_size=8 * CHUNK, max_concurrency=2)

    async def stream_get(self, path: str, start: int = 0, end: int | None = None) -> AsyncIterator[bytes]:
        """Yield the bytes [start, end) in pieces of about CHUNK. Raises FileNotFoundError before the first piece."""
        with storage_errors("read", path):
            if end is not None:
                result = await obstore.get_async(self.store, path, options={"range": (start, end)})
            elif start:
                result = await obstore.get_async(self.store, path, options={"range": {"offset": start}})
            else:
                result = await obstore.get_async(self.store, path)
            async for chunk in result.stream(min_chunk_size=CHUNK):
                yield bytes(chunk)

    def rename(self, source: str, target: str) -> None:
        """Move a file. Raises FileNotFoundError."""
        with storage_errors("write", target):
            obstore.rename(self.store, source, target)

    def entries(self, prefix: str) -> Iterator[Entry]:
        """Yield all files under the folder `prefix`, sorted by path."""
        with storage_errors("list", prefix):
            found = [_entry(meta) for page in obstore.list(self.store, prefix) for meta in page]
        yield from sorted(found, key=lambda entry: entry.path)

    def walk(self, prefix: str) -> Iterator[Entry]:
        """Yield all files under the folder `prefix` in any order, page by page, without holding all in memory."""
        pages = iter(obstore.list(self.store, prefix or None))
        while True:
            with storage_errors("list", prefix):
                page = next(pages, None)
            if page is None:
                return
            for meta in page:
                yield _entry(meta)

    def children(self, prefix: str) -> list[str]:
        """Return the names of the folders directly under `prefix`, sorted."""
        with storage_errors("list", prefix):
            result = obstore.list_with_delimiter(self.store, prefix)
        return sorted(folder.rsplit("/", 1)[-1] for folder in result["common_prefixes"])

    def delete(self, path: str) -> None:
        """Delete a file, if it exists."""
        with storage_errors("delete", path), suppress(FileNotFoundError):
            obstore.delete(self.store, path)

    def delete_prefix(self, prefix: str) -> int:
        """Delete all files under a folder, and return their number."""
        paths = [entry.path for entry in self.entries(prefix)]
        for path in paths:
            self.delete(path)
        return len(paths)

    def delete_stale(self, prefix: str, seconds: float) -> int:
        """Delete the files under a folder that are older than `seconds`, and return their number.

        This includes the files in which the local store stages a write. They are not listed, and a process that is
        killed leaves them behind.
        """
        before = datetime.now(UTC).timestamp() - seconds
        stale = [entry.path for entry in self.entries(prefix) if entry.modified.timestamp() < before]
        for path in stale:
            self.delete(path)
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
        for entry in entries:
            self.delete(entry.path)
        return len(entries)

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
        """Copy a stored file to a local path, atomically. Raises FileNotFoundError."""
        with storage_errors("read", path), replacing(target) as part, part.open("wb") as file:
            for chunk in obstore.get(self.store, path).stream(min_chunk_size=CHUNK):
                file.write(chunk)

    def download_prefix(self, prefix: str, folder: Path) -> list[str]:
        """Copy all files under `prefix` to `folder`, except those of the same size already there; return the names."""
        names = []
        for entry in self.entries(prefix):
            name = entry.path[len(prefix.rstrip("/")) + 1 :]
            target = folder / name
            if not (target.is_file() and target.stat().st_size == entry.size):
                self.download(entry.path, target)
            names.append(name)
        return names

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


@contextmanager
def storage_errors(verb: str, path: str) -> Iterator[None]:
    """Convert errors of obstore, which contain Rust debug output, into a StorageError with one sentence."""
    try:
        yield
    except FileNotFoundError:
        raise
    except (BaseError, OSError) as error:
        text = str(error)
        fact = text.split("\n\nDebug source")[0].strip()
        if any(sign in text for sign in _FULL):
            raise StorageFullError(f"Storage is full: it could not {verb} {path} ({fact}).") from error
        raise StorageError(f"Storage could not {verb} {path}: {fact}.") from error


def _s3_client() -> "ClientConfig":
    """Return options for S3. obstore's default timeout of 30 s includes the body, which is short for a large model."""
    endpoint = os.environ.get("AWS_ENDPOINT_URL") or os.environ.get("AWS_ENDPOINT") or ""
    return {"connect_timeout": "5s", "timeout": "600s", "allow_http": endpoint.startswith("http://")}


def _entry(meta: "obstore.ObjectMeta") -> Entry:
    etag = (meta["e_tag"] or f"{meta['size']:x}-{meta['last_modified'].timestamp()}").removeprefix("W/")
    return Entry(meta["path"], meta["size"], etag.strip('"'), meta["last_modified"])
