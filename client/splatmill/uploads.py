"""Uploads of the files of a capture: several at a time, each with its SHA-256."""

import asyncio
import hashlib
import mimetypes
import unicodedata
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from splatmill.connection import Connection, read_answer
from splatmill.errors import InvalidRequest, NothingToUpload
from splatmill.local_capture import LocalFile
from splatmill.schema.captures import SHA256_HEADER, CaptureFile, Role
from splatmill.schema.events import Progress
from splatmill.schema.problems import Problem

CHUNK = 256 * 1024  # bytes
CONCURRENT = 4

# A photo that is refused with one of these codes is left out and reported; the others are still uploaded.
BAD_PHOTO_CODES = frozenset(
    {"not_an_image", "image_truncated", "image_too_small", "image_too_large", "file_empty"}
)

OnProgress = Callable[[Progress], None]


@dataclass(frozen=True)
class Uploaded:
    """The result of an upload.

    files: the files that the capture now holds of those that were sent.
    refused: names of the photos that the server refused, each with the reason.
    """

    files: tuple[CaptureFile, ...]
    refused: tuple[tuple[str, Problem], ...]


async def upload(
    connection: Connection,
    capture_id: str,
    files: Sequence[LocalFile],
    on_progress: OnProgress | None = None,
    concurrent: int = CONCURRENT,
    stored_files: Sequence[CaptureFile] = (),
) -> Uploaded:
    """Upload `files` to a capture, `concurrent` at a time. A file that is already stored is not stored twice.

    `stored_files` are those that the capture is known to hold; equal files among `files` are not sent.

    Raises ConnectionFailed, NothingToUpload for a file that cannot be read, and a subclass of `Refused`, unless it
    concerns one photo and others are left.
    """
    total = sum(file.size for file in files)
    stored: list[CaptureFile] = []
    flawed: list[tuple[str, InvalidRequest]] = []
    done = 0
    # Poses and masks go first: if one is refused, the upload fails before the photos are sent.
    held = {(file.role, file.name): file for file in stored_files}
    queue = iter(sorted(files, key=lambda file: file.role is Role.images))

    async def work() -> None:
        nonlocal done
        for file in queue:
            try:
                stored.append(await _send(connection, capture_id, file, held))
            except InvalidRequest as error:
                if file.role is not Role.images or error.code not in BAD_PHOTO_CODES:
                    raise
                flawed.append((file.name, error))
            done += file.size
            if on_progress is not None:
                on_progress(Progress(stage="uploading", done=done, total=total, note=file.name))

    try:
        async with asyncio.TaskGroup() as group:
            for _ in range(concurrent):
                group.create_task(work())
    except BaseExceptionGroup as errors:
        raise errors.exceptions[0] from None
    if flawed and not any(file.role is Role.images for file in stored):
        raise flawed[0][1]
    return Uploaded(tuple(stored), tuple((name, error.problem) for name, error in flawed))


async def _send(
    connection: Connection, capture_id: str, file: LocalFile, held: Mapping[tuple[Role, str], CaptureFile]
) -> CaptureFile:
    digest, size = await asyncio.to_thread(_digest, file.path)
    # The server stores names in this form of Unicode (see `safe_name`).
    there = held.get((file.role, unicodedata.normalize("NFC", file.name)))
    if there is not None and (there.sha256, there.size) == (digest, size):
        return there
    # The media types of .ply and .bin differ between systems, and the server does not need those of poses.
    known = mimetypes.guess_type(file.name)[0] if file.role is not Role.poses else None
    media_type = known or "application/octet-stream"
    response = await connection.request(
        "PUT",
        f"/v1/captures/{capture_id}/{file.role.value}/{quote(file.name)}",
        body=lambda: _chunks(file.path),
        headers={"Content-Type": media_type, "Content-Length": str(size), SHA256_HEADER: digest},
    )
    return read_answer(CaptureFile, response)


def _digest(path: Path) -> tuple[str, int]:
    try:
        with path.open("rb") as source:
            digest = hashlib.file_digest(source, "sha256")
            return digest.hexdigest(), source.tell()
    except OSError as error:
        raise NothingToUpload(f"{path} cannot be read: {error.strerror}.") from error


async def _chunks(path: Path) -> AsyncIterator[bytes]:
    with path.open("rb") as source:
        while chunk := await asyncio.to_thread(source.read, CHUNK):
            yield chunk
