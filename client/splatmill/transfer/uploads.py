"""Uploads of the files of a capture: several at a time, each with its SHA-256."""

import asyncio
import hashlib
import mimetypes
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from urllib.parse import quote

from splatmill.errors import InvalidRequest, NothingToUpload, SplatmillError
from splatmill.schema.problems import Problem
from splatmill.schema.resources.captures import SHA256_HEADER, CaptureFile, Role
from splatmill.schema.resources.jobs.events import Progress
from splatmill.transfer.chunked_uploads import PIECE, OnPosition, read_range, send_in_pieces
from splatmill.transfer.connection import Connection, read_answer
from splatmill.transfer.local_capture import LocalFile

CONCURRENT = 4

REPORT_SECONDS = 0.1
"""Seconds between two reports of the bytes sent."""

# A photo that is refused with one of these codes is left out and reported; the others are still uploaded.
BAD_PHOTO_CODES = frozenset(
    {"not_an_image", "image_truncated", "image_too_small", "image_too_large", "file_empty"}
)

OnProgress = Callable[[Progress], None]


@dataclass(frozen=True)
class Uploaded:
    """The result of an upload.

    files: the files that the capture now holds of those that were sent.
    refused: names of the photos that the server refused, or that have no name it would accept, each with the reason.
    renamed: names of the files that are stored under other names, each with its name in the capture.
    """

    files: tuple[CaptureFile, ...]
    refused: tuple[tuple[str, Problem], ...]
    renamed: tuple[tuple[str, str], ...] = ()


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
    flawed: list[tuple[str, Problem, SplatmillError]] = []
    tally = _Tally(total, on_progress)
    # Poses and masks go first: if one is refused, the upload fails before the photos are sent.
    held = {(file.role, file.name): file for file in stored_files}
    queue = iter(sorted(files, key=lambda file: file.role is Role.images))

    async def work() -> None:
        for file in queue:
            try:
                stored.append(await _send(connection, capture_id, file, held, tally.of(file)))
            except InvalidRequest as error:
                if file.role is not Role.images or error.code not in BAD_PHOTO_CODES:
                    raise
                flawed.append((file.name, error.problem, error))
            except NothingToUpload as error:  # it was deleted since it was listed
                if file.role is Role.poses or len(files) == 1:
                    raise
                flawed.append((file.name, Problem.of("file_not_found", str(error)), error))
            tally.end(file)

    try:
        async with asyncio.TaskGroup() as group:
            for _ in range(concurrent):
                group.create_task(work())
    except BaseExceptionGroup as errors:
        raise errors.exceptions[0] from None
    if flawed and not any(file.role is Role.images for file in stored):
        raise flawed[0][2]
    return Uploaded(tuple(stored), tuple((name, problem) for name, problem, _ in flawed))


@dataclass
class _Tally:
    """The bytes sent of all files. What is reported never decreases, though a file may be sent again.

    total: bytes of all files.
    positions: bytes sent of each file, by role and name; `sent` is their sum.
    """

    total: int
    on_progress: OnProgress | None
    positions: dict[tuple[Role, str], int] = field(default_factory=dict)
    sent: int = 0
    reported: int = 0
    next_report: float = 0.0

    def of(self, file: LocalFile) -> OnPosition:
        """Return the function that is called with how many bytes of a file were sent."""

        return lambda position: self._at(file, position)

    def end(self, file: LocalFile) -> None:
        """Count a file as done, whether it was sent, was there already, or was refused."""
        self._at(file, file.size, always=True)

    def _at(self, file: LocalFile, position: int, always: bool = False) -> None:
        self.sent += position - self.positions.get((file.role, file.name), 0)
        self.positions[file.role, file.name] = position
        if self.on_progress is None or (monotonic() < self.next_report and not always):
            return
        self.next_report = monotonic() + REPORT_SECONDS
        self.reported = max(self.reported, self.sent)
        self.on_progress(Progress(stage="uploading", done=self.reported, total=self.total, note=file.name))


async def _send(
    connection: Connection,
    capture_id: str,
    file: LocalFile,
    held: Mapping[tuple[Role, str], CaptureFile],
    on_position: OnPosition,
) -> CaptureFile:
    digest, size = await asyncio.to_thread(_digest, file.path)
    # The server stores names in this form of Unicode (see `safe_name`).
    there = held.get((file.role, unicodedata.normalize("NFC", file.name)))
    if there is not None and (there.sha256, there.size) == (digest, size):
        return there
    # The media types of .ply and .bin differ between systems, and the server does not need those of poses.
    known = mimetypes.guess_type(file.name)[0] if file.role is not Role.poses else None
    media_type = known or "application/octet-stream"
    address = f"/v1/captures/{capture_id}/{file.role.value}/{quote(file.name)}"
    headers = {"Content-Type": media_type, SHA256_HEADER: digest}
    if size > PIECE:
        return await send_in_pieces(connection, address, file.path, size, headers, on_position)
    response = await connection.request(
        "PUT",
        address,
        body=lambda: read_range(file.path, 0, size, on_position),
        headers={**headers, "Content-Length": str(size)},
    )
    return read_answer(CaptureFile, response)


async def key_of(files: Sequence[LocalFile]) -> str:
    """Return a key that is the same for the same files that can be read: equal roles, names, sizes and contents."""
    lines = []
    for file in files:
        try:
            digest, size = await asyncio.to_thread(_digest, file.path)
        except NothingToUpload:  # `upload` leaves it out, or ends with this error
            continue
        lines.append(f"{file.role.value}/{file.name}\n{size} {digest}")
    lines.sort()
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _digest(path: Path) -> tuple[str, int]:
    try:
        with path.open("rb") as source:
            digest = hashlib.file_digest(source, "sha256")
            return digest.hexdigest(), source.tell()
    except OSError as error:
        raise NothingToUpload(f"{path} cannot be read: {error.strerror}.") from error
