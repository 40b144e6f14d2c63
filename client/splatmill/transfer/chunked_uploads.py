"""The upload of a large file in pieces, continued at the server's offset after any break.

Nothing is kept on this machine: the server knows an upload by the file's name, size and digest, so a command that was
killed and is run again continues where it stopped.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path

import httpx

from splatmill.errors import (
    Conflict,
    ConnectionFailed,
    NotFound,
    NothingToUpload,
    Refused,
    ServerError,
    Unavailable,
)
from splatmill.schema.headers import read_integer, read_token
from splatmill.schema.resources.captures import CaptureFile
from splatmill.schema.resources.uploads import (
    PARTIAL_UPLOAD,
    UPLOAD_COMPLETE,
    UPLOAD_LENGTH,
    UPLOAD_OFFSET,
    read_boolean,
    write_boolean,
)
from splatmill.transfer.connection import TRANSIENT, Connection, backoff, own_path, read_answer

CHUNK = 256 * 1024
"""Bytes read and sent at a time."""

PIECE = 16 << 20
"""Bytes of one request. A larger file is sent in several: each answer says that its bytes are safe."""

PATIENCE = 4
"""Breaks without progress that end an upload, as a multiple of the retries of a request."""

OnPosition = Callable[[int], None]
"""Called with the number of bytes of the file that were sent."""


async def send_in_pieces(
    connection: Connection,
    address: str,
    path: Path,
    size: int,
    headers: Mapping[str, str],
    on_position: OnPosition,
) -> CaptureFile:
    """Upload the file at `path`, of `size` bytes, to `address`; return its record.

    headers: those of an upload in one request, with the digest of the whole file.

    Raises ConnectionFailed, and a subclass of `Refused`, if there is no progress for long.
    """
    upload: str | None = None
    reached, breaks = -1, 0
    while True:
        try:
            if upload is None:
                begin = {
                    UPLOAD_COMPLETE: write_boolean(False),
                    UPLOAD_LENGTH: str(size),
                    "Content-Length": "0",
                }
                response = await connection.request("PUT", address, headers={**headers, **begin})
                if read_boolean(response.headers.get(UPLOAD_COMPLETE)):
                    on_position(size)
                    return read_answer(CaptureFile, response)
                upload = _path_of(connection.server, response.headers.get("Location"))
            else:
                response = await connection.request("HEAD", upload)
                if read_boolean(response.headers.get(UPLOAD_COMPLETE)):
                    upload = None  # the answer with the file was lost; beginning again returns it
                    continue
            offset = read_integer(response.headers.get(UPLOAD_OFFSET))
            if upload is None or offset is None:
                raise ConnectionFailed(
                    f"{connection.server} does not take files in several requests.",
                    "Check that its version fits this client.",
                )
            while True:
                on_position(offset)
                if offset > reached:
                    reached, breaks = offset, 0
                end = min(offset + PIECE, size)
                response = await _append(connection, upload, path, offset, end, end == size, on_position)
                if end == size:
                    return read_answer(CaptureFile, response)
                offset = end
        except (ConnectionFailed, Refused) as error:
            breaks += 1
            if breaks > connection.retries * PATIENCE or not _passes(error):
                raise
            if isinstance(error, NotFound) or (
                isinstance(error, Conflict) and error.code == "upload_completed"
            ):
                upload = None
            await asyncio.sleep(backoff(breaks))


def _path_of(server: str, location: str | None) -> str | None:
    """Return the address of an upload, or None for one that is not a path on the same server, which has the key."""
    path = read_token(location)
    own = path is not None and path.startswith("/") and not path.startswith("//")
    return own_path(server, path) if path is not None and own else None


async def _append(
    connection: Connection,
    upload: str,
    path: Path,
    start: int,
    end: int,
    last: bool,
    on_position: OnPosition,
) -> httpx.Response:
    return await connection.request(
        "PATCH",
        upload,
        body=lambda: read_range(path, start, end, on_position),
        headers={
            "Content-Type": PARTIAL_UPLOAD,
            "Content-Length": str(end - start),
            UPLOAD_OFFSET: str(start),
            UPLOAD_COMPLETE: write_boolean(last),
        },
        repeatable=False,  # what was kept of a request that broke is asked for first
    )


async def read_range(path: Path, start: int, end: int, on_position: OnPosition) -> AsyncIterator[bytes]:
    """Yield the bytes [start, end) of a file, and tell the position after each chunk that was taken.

    Raises NothingToUpload if the file has become shorter.
    """
    with path.open("rb") as source:
        source.seek(start)
        while start < end:
            chunk = await asyncio.to_thread(source.read, min(CHUNK, end - start))
            if not chunk:
                raise NothingToUpload(f"{path} has changed while it was uploaded.", "Upload it again.")
            yield chunk
            start += len(chunk)
            on_position(start)


def _passes(error: Exception) -> bool:
    """Return whether it makes sense to go on with the upload after an error."""
    if isinstance(error, Unavailable | ServerError):
        return error.problem.status in TRANSIENT or error.problem.status == 500
    codes = ("upload_offset_differs", "upload_completed", "upload_not_found", "not_found", "body_cut_off")
    return isinstance(error, ConnectionFailed) or (isinstance(error, Refused) and error.code in codes)
