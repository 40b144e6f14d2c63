"""Uploading a capture's files: from disk, several at a time, each with its SHA-256."""

import asyncio
import hashlib
import mimetypes
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from splatmill.connection import Connection, read_answer
from splatmill.errors import InvalidRequest, NothingToUpload
from splatmill.layout import LocalFile
from splatmill.schema.captures import SHA256_HEADER, CaptureFile, Role
from splatmill.schema.events import Progress
from splatmill.schema.problems import Problem

CHUNK = 256 * 1024
AT_A_TIME = 4

# One photo with these flaws is left out and reported; the others still make a scene.
FLAWS_OF_ONE_PHOTO = frozenset(
    {"not_an_image", "image_truncated", "image_too_small", "image_too_large", "file_empty"}
)

OnProgress = Callable[[Progress], None]


@dataclass(frozen=True)
class Uploaded:
    """What is stored now, and which photos the server would not take, with its reasons."""

    files: tuple[CaptureFile, ...]
    refused: tuple[tuple[str, Problem], ...]


async def upload(
    connection: Connection,
    capture_id: str,
    files: Sequence[LocalFile],
    on_progress: OnProgress | None = None,
    at_a_time: int = AT_A_TIME,
) -> Uploaded:
    """Send `files` into a capture; a file that is already there with the same bytes is not stored twice.

    Raises the first `Refused` that is not about one photo alone, and also that one when no photo is left.
    """
    total = sum(file.size for file in files)
    stored: list[CaptureFile] = []
    flawed: list[tuple[str, InvalidRequest]] = []
    done = 0
    # Poses and masks first: a refusal of theirs concerns the whole capture and should come before the photos.
    queue = iter(sorted(files, key=lambda file: file.role is Role.images))

    async def work() -> None:
        nonlocal done
        for file in queue:
            try:
                stored.append(await _send(connection, capture_id, file))
            except InvalidRequest as error:
                if file.role is not Role.images or error.code not in FLAWS_OF_ONE_PHOTO:
                    raise
                flawed.append((file.name, error))
            done += file.size
            if on_progress is not None:
                on_progress(Progress(stage="uploading", done=done, total=total, note=file.name))

    try:
        async with asyncio.TaskGroup() as group:
            for _ in range(at_a_time):
                group.create_task(work())
    except BaseExceptionGroup as errors:
        raise errors.exceptions[0] from None
    if flawed and not any(file.role is Role.images for file in stored):
        raise flawed[0][1]
    return Uploaded(tuple(stored), tuple((name, error.problem) for name, error in flawed))


async def _send(connection: Connection, capture_id: str, file: LocalFile) -> CaptureFile:
    digest, size = await asyncio.to_thread(_digest, file.path)
    # What a machine calls a .ply or .bin differs; of poses the service reads the bytes alone.
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
