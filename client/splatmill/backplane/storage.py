"""Storage for captures, checkpoints and models: a local folder by default, S3-compatible by URL, through obstore.

Every write is atomic: a reader sees the old file, the new one, or none, never a part. Paths are those of
`splatmill.backplane.layout`. Synchronous methods are for the worker and for threads; the `stream_*` ones are
asynchronous, so that the API passes files through without holding them in memory.
"""

import os
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

from splatmill.files import replacing

if TYPE_CHECKING:  # These names exist in its stubs alone.
    from obstore.store import ClientConfig, RetryConfig

CHUNK = 1 << 20
"""Bytes per piece when a file is streamed: memory per transfer stays at a few of these."""

_S3_RETRY: "RetryConfig" = {"max_retries": 4, "retry_timeout": timedelta(seconds=20)}
"""obstore's own patience is three minutes, in which a client of the API has long given up."""

_FULL = ("os error 28", "os error 122", "os error 27", "No space left", "QuotaExceeded", "StorageFull")


class StorageError(Exception):
    """Storage cannot be read or written now; the text says what was tried and what came back."""


class StorageFullError(StorageError):
    """No room (disk full, quota reached, file size limit): nothing was stored."""


@dataclass(frozen=True)
class Entry:
    """A stored file: `path` below the storage root, `size` in bytes, `etag` without quotes, and its time."""

    path: str
    size: int
    etag: str
    modified: datetime


class Storage:
    """Files by path under one root.

    `url` is `file:///folder` (made when missing), a plain folder path, or `s3://bucket/prefix` with the usual
    `AWS_*` environment variables. Raises StorageError with a sentence when it cannot be opened.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self.root: Path | None = None
        parts = urlsplit(url)
        if parts.scheme in ("", "file"):
            self.root = Path(unquote(parts.path)).expanduser().absolute()
            try:
                self.root.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise StorageError(f"The storage folder {self.root} cannot be made: {error}.") from error
            if not os.access(self.root, os.W_OK | os.X_OK):
                raise StorageError(f"The storage folder {self.root} is not writable by this user.")
            # Empty folders go with their last file, so that deleting a capture leaves no skeleton behind.
            self.store: ObjectStore = LocalStore(self.root, automatic_cleanup=True)
        elif parts.scheme == "s3":
            self.store = from_url(url, client_options=_s3_client(), retry_config=_S3_RETRY)
        else:
            raise StorageError(
                f"SPLATMILL_STORAGE={url!r} is neither file:///folder nor s3://bucket/prefix; give one of these."
            )

    def local_path(self, path: str) -> Path | None:
        """Where `path` lies on this machine, or None when storage is remote. The file need not exist."""
        return None if self.root is None else self.root / path

    def head(self, path: str) -> Entry | None:
        """The entry at `path`, or None when there is none."""
        with _sentences("read", path):
            try:
                return _entry(obstore.head(self.store, path))
            except FileNotFoundError:
                return None

    def exists(self, path: str) -> bool:
        return self.head(path) is not None

    def get(self, path: str, start: int = 0, end: int | None = None) -> bytes:
        """The bytes [start, end) of a small file. Raises FileNotFoundError."""
        with _sentences("read", path):
            if start == 0 and end is None:
                return bytes(obstore.get(self.store, path).bytes())
            stop = end if end is not None else obstore.head(self.store, path)["size"]
            return bytes(obstore.get_range(self.store, path, start=start, end=stop))

    def put(self, path: str, data: bytes | Path) -> None:
        """Store bytes, or the file at a local path (streamed), replacing what was there."""
        with _sentences("write", path):
            obstore.put(self.store, path, data)

    def put_new(self, path: str, data: bytes) -> bool:
        """Store bytes only if nothing is there yet; False when something is. Decides races between writers."""
        with _sentences("write", path):
            try:
                obstore.put(self.store, path, data, mode="create")
            except AlreadyExistsError:
                return False
            return True

    async def stream_put(self, path: str, chunks: AsyncIterator[bytes]) -> None:
        """Store what `chunks` yields. If it raises, nothing is stored and the exception passes through."""
        with _sentences("write", path):
            await obstore.put_async(self.store, path, chunks, chunk_size=8 * CHUNK, max_concurrency=2)

    async def stream_get(self, path: str, start: int = 0, end: int | None = None) -> AsyncIterator[bytes]:
        """The bytes [start, end) in pieces of about CHUNK. Raises FileNotFoundError before the first piece."""
        with _sentences("read", path):
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
        with _sentences("write", target):
            obstore.rename(self.store, source, target)

    def entries(self, prefix: str) -> Iterator[Entry]:
        """Every file under the folder `prefix`, in order of path."""
        with _sentences("list", prefix):
            found = [_entry(meta) for page in obstore.list(self.store, prefix) for meta in page]
        yield from sorted(found, key=lambda entry: entry.path)

    def children(self, prefix: str) -> list[str]:
        """The names of the folders directly under `prefix`, sorted."""
        with _sentences("list", prefix):
            result = obstore.list_with_delimiter(self.store, prefix)
        return sorted(folder.rsplit("/", 1)[-1] for folder in result["common_prefixes"])

    def delete(self, path: str) -> None:
        """Remove one file; nothing happens when there is none."""
        with _sentences("delete", path), suppress(FileNotFoundError):
            obstore.delete(self.store, path)

    def delete_prefix(self, prefix: str) -> int:
        """Remove every file under a folder and return how many went."""
        paths = [entry.path for entry in self.entries(prefix)]
        for path in paths:
            self.delete(path)
        return len(paths)

    def delete_stale(self, prefix: str, seconds: float) -> int:
        """Remove the files under a folder that are older than this, and how many; also the ones the local store
        stages a write in, which no listing shows and a killed process leaves behind."""
        before = datetime.now(UTC).timestamp() - seconds
        stale = [entry.path for entry in self.entries(prefix) if entry.modified.timestamp() < before]
        for path in stale:
            self.delete(path)
        staged = [] if self.root is None else (self.root / prefix).glob("*#*")
        left = [path for path in staged if path.stat().st_mtime < before]
        for file in left:
            file.unlink(missing_ok=True)
        return len(stale) + len(left)

    def download(self, path: str, target: Path) -> None:
        """Copy a stored file to a local path, atomically. Raises FileNotFoundError."""
        with _sentences("read", path), replacing(target) as part, part.open("wb") as file:
            for chunk in obstore.get(self.store, path).stream(min_chunk_size=CHUNK):
                file.write(chunk)

    def download_prefix(self, prefix: str, folder: Path) -> list[str]:
        """Copy every file under `prefix` into `folder`; files there with the same size stay. Returns the names."""
        names = []
        for entry in self.entries(prefix):
            name = entry.path[len(prefix.rstrip("/")) + 1 :]
            target = folder / name
            if not (target.is_file() and target.stat().st_size == entry.size):
                self.download(entry.path, target)
            names.append(name)
        return names

    def check(self) -> None:
        """Prove that storage takes a write. Raises StorageError when it does not."""
        path = f"health/{os.getpid()}"
        self.put(path, b"ok")
        self.delete(path)


@contextmanager
def _sentences(verb: str, path: str) -> Iterator[None]:
    """Turn obstore's errors, which carry a Rust debug dump, into one sentence; FileNotFoundError stays itself."""
    try:
        yield
    except FileNotFoundError:
        raise
    except (BaseError, OSError) as error:
        text = str(error)
        fact = text.split("\n\nDebug source")[0].strip()
        if any(sign in text for sign in _FULL):
            raise StorageFullError(f"Storage is full: could not {verb} {path} ({fact}).") from error
        raise StorageError(f"Storage could not {verb} {path}: {fact}.") from error


def _s3_client() -> "ClientConfig":
    """obstore's own limit of 30 s counts the whole body, which a large model exceeds on a slow line."""
    endpoint = os.environ.get("AWS_ENDPOINT_URL") or os.environ.get("AWS_ENDPOINT") or ""
    return {"connect_timeout": "5s", "timeout": "600s", "allow_http": endpoint.startswith("http://")}


def _entry(meta: "obstore.ObjectMeta") -> Entry:
    etag = (meta["e_tag"] or f"{meta['size']:x}-{meta['last_modified'].timestamp()}").removeprefix("W/")
    return Entry(meta["path"], meta["size"], etag.strip('"'), meta["last_modified"])
