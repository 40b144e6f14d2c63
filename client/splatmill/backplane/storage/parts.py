"""The bytes of an upload that arrives in several requests, before it is a file.

A part only grows, and only at its end. A writer says where it believes the end to be; of several writers that name the
same end, one succeeds and the others learn the true one, also if they are different processes. What is held is
therefore always a prefix of what one sequence of requests has sent, without gaps and without mixed blocks.

On a local disk, a part is one file that is appended to. In a bucket, where objects cannot grow, each block is an object
named by its offset, and `assemble` puts them together.
"""

import fcntl
import os
from collections.abc import AsyncIterator, Iterator
from typing import Protocol

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.errors import storage_errors
from splatmill.backplane.storage.storage import CHUNK, Storage
from splatmill.files import sync_to_disk


class EndMoved(Exception):
    """A writer was wrong about the end of a part: another one has appended. `offset` is the true end in bytes."""

    def __init__(self, offset: int) -> None:
        super().__init__(f"The part ends at {offset}.")
        self.offset = offset


class Part(Protocol):
    """The bytes received so far. Methods raise FileNotFoundError if the part was deleted, and StorageError."""

    block: int
    """Bytes to append at a time: large enough to be cheap, small enough to be held in memory."""

    def create(self) -> None:
        """Begin an empty part, unless there is one."""

    def offset(self) -> int:
        """Return the number of bytes held."""

    def append(self, at: int, data: bytes) -> int:
        """Append bytes at the end, which is at offset `at`; return the new end. Raises EndMoved."""

    def sync(self) -> None:
        """Return once the bytes held survive a power cut."""

    def read(self) -> Iterator[bytes]:
        """Yield the bytes in order."""

    async def assemble(self, target: str) -> str:
        """Make one file of the part and return its path in storage: `target`, or where it already is one."""


def open_part(storage: Storage, capture_id: str, upload_id: str) -> Part:
    """Return the part of an upload."""
    if storage.root is None:
        return _Objects(storage, layout.upload_blocks(capture_id, upload_id))
    return _File(storage, layout.upload_part(capture_id, upload_id))


class _File:
    """A part in one file. Its size is the offset. Appending holds a lock for the time of one block."""

    block = CHUNK

    def __init__(self, storage: Storage, path: str) -> None:
        place = storage.local_path(path)
        assert place is not None
        self._path, self._place = path, place

    def create(self) -> None:
        with storage_errors("write", self._path):
            self._place.parent.mkdir(parents=True, exist_ok=True)
            self._place.touch()

    def offset(self) -> int:
        with storage_errors("read", self._path):
            return self._place.stat().st_size

    def append(self, at: int, data: bytes) -> int:
        with storage_errors("write", self._path):
            descriptor = os.open(self._place, os.O_WRONLY | os.O_APPEND)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX)
                end = os.fstat(descriptor).st_size
                if end != at:
                    raise EndMoved(end)
                left = memoryview(data)
                while left:
                    left = left[os.write(descriptor, left) :]
            finally:
                os.close(descriptor)
        return at + len(data)

    def sync(self) -> None:
        with storage_errors("write", self._path):
            for path in (self._place, self._place.parent):
                sync_to_disk(path)

    def read(self) -> Iterator[bytes]:
        with storage_errors("read", self._path), self._place.open("rb") as file:
            while block := file.read(CHUNK):
                yield block

    async def assemble(self, target: str) -> str:
        return self._path


class _Objects:
    """A part in objects, one per block. An object is written only if there is none of its offset yet."""

    block = 8 * CHUNK

    def __init__(self, storage: Storage, folder: str) -> None:
        self._storage, self._folder = storage, folder

    def create(self) -> None:
        pass  # a folder exists with its first object

    def offset(self) -> int:
        return self._blocks()[1]

    def append(self, at: int, data: bytes) -> int:
        if not self._storage.put_new(f"{self._folder}/{at:016d}", data):
            raise EndMoved(self.offset())
        return at + len(data)

    def sync(self) -> None:
        pass  # a bucket has stored an object once it has answered

    def read(self) -> Iterator[bytes]:
        for path in self._blocks()[0]:
            yield self._storage.get(path)

    async def assemble(self, target: str) -> str:
        paths = self._blocks()[0]

        async def blocks() -> AsyncIterator[bytes]:
            for path in paths:
                async for chunk in self._storage.stream_get(path):
                    yield chunk

        await self._storage.stream_put(target, blocks())
        return target

    def _blocks(self) -> tuple[list[str], int]:
        """Return the paths of the blocks in order, and the end of the last one before a gap."""
        paths, end = [], 0
        for entry in self._storage.entries(self._folder):
            if int(entry.path.rsplit("/", 1)[-1]) != end:
                break
            paths.append(entry.path)
            end += entry.size
        return paths, end
