"""Downloads that resume where an earlier attempt stopped, and write the file whole or not at all."""

import asyncio
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import httpx

from splatmill.errors import DownloadFailed, InvalidRequest, Unavailable
from splatmill.files import move_into_place
from splatmill.schema.headers import read_integer, read_token
from splatmill.schema.resources.captures import SHA256_HEADER
from splatmill.transfer.connection import LONGEST_WISH, Connection, backoff

AnyPath = str | os.PathLike[str]
OnBytes = Callable[[int, int | None], None]
"""Called with the number of bytes received so far, and the size of the file where it is known."""


def target_of(path: AnyPath, name: str) -> Path:
    """Return the path to write to: `path`, or `path`/`name` if `path` is a folder or ends in a separator."""
    target = Path(path).expanduser()
    if target.is_dir() or os.fspath(path).endswith(("/", os.sep)):
        target = target / name
    return target


async def download(
    connection: Connection,
    address: str,
    target: Path,
    *,
    sha256: str | None = None,
    on_bytes: OnBytes | None = None,
) -> Path:
    """Download the file at `address` to `target`, and return `target`.

    The bytes are collected in `target.part`, beside the ETag of the file; a later call resumes there if the ETag is
    unchanged. `target` is replaced once the size agrees, and the SHA-256 if the server or the caller gives one.

    Raises DownloadFailed when the SHA-256 differs, ConnectionFailed, a subclass of `Refused`, or OSError when the file
    cannot be written.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    part = _Part(target)
    tries = 0
    while True:
        tries += 1
        before = part.size
        try:
            announced = await _fetch(connection, address, part, on_bytes)
            break
        except (httpx.TransportError, Unavailable) as error:
            if part.size > before:
                tries = 1  # count only attempts that received nothing
            if tries > connection.retries:
                raise connection.lost(error) if isinstance(error, httpx.TransportError) else error from error
            wish = error.retry_after if isinstance(error, Unavailable) else None
            await asyncio.sleep(max(backoff(tries), min(wish or 0.0, LONGEST_WISH)))
        except InvalidRequest as error:
            # Either all bytes had arrived and only the rename was missing, or the file has changed: start again.
            if error.problem.status != 416 or not before:
                raise
            part.discard()
    expected = sha256 or announced
    if expected is not None:
        digest = await asyncio.to_thread(part.digest)
        if digest != expected:
            part.discard()
            raise DownloadFailed(
                f"The SHA-256 of the downloaded {target.name} is {digest[:12]}..., not {expected[:12]}...",
                "The partial file was removed; download it again.",
            )
    part.move_into_place()
    return target


class _Part:
    """The partial file of a download, and the ETag of the file it is a part of."""

    def __init__(self, target: Path) -> None:
        self.target = target
        self.path = target.with_name(target.name + ".part")
        self.etag_path = target.with_name(target.name + ".part.etag")

    @property
    def size(self) -> int:
        """Number of bytes after which the download can resume; 0 without an ETag, which would prove that they fit."""
        return self.path.stat().st_size if self.path.exists() and self.etag is not None else 0

    @property
    def etag(self) -> str | None:
        return self.etag_path.read_text() if self.etag_path.exists() else None

    def begin(self, etag: str | None) -> None:
        self.discard()
        # Files with equal weak ETags may differ in their bytes.
        token = read_token(etag)
        if token is not None and not token.startswith("W/"):
            self.etag_path.write_text(token)
        self.path.touch()

    def digest(self) -> str:
        with self.path.open("rb") as source:
            return hashlib.file_digest(source, "sha256").hexdigest()

    def discard(self) -> None:
        self.path.unlink(missing_ok=True)
        self.etag_path.unlink(missing_ok=True)

    def move_into_place(self) -> None:
        move_into_place(self.path, self.target, sync=True)
        self.etag_path.unlink(missing_ok=True)


async def _fetch(connection: Connection, address: str, part: _Part, on_bytes: OnBytes | None) -> str | None:
    """Send one request, append the missing bytes, and return the SHA-256 that the server announces."""
    headers = {"Accept-Encoding": "identity"}
    if part.size and part.etag:
        headers |= {"Range": f"bytes={part.size}-", "If-Range": part.etag}
    async with connection.stream("GET", address, headers=headers) as response:
        if response.status_code != 206:
            part.begin(response.headers.get("ETag"))
        start = part.path.stat().st_size
        if response.status_code == 206 and not response.headers.get("Content-Range", "").startswith(
            f"bytes {start}-"
        ):
            part.discard()
            raise httpx.RemoteProtocolError("the server sent another range than the requested one")
        length = read_integer(response.headers.get("Content-Length"))
        total = start + length if length is not None else None
        with part.path.open("ab") as sink:
            async for chunk in response.aiter_bytes():
                sink.write(chunk)
                if on_bytes is not None:
                    on_bytes(sink.tell(), total)
            size = sink.tell()
        if total is not None and size != total:
            raise httpx.RemoteProtocolError(f"{size} of {total} bytes arrived")
        digest: str | None = response.headers.get(SHA256_HEADER)
        return digest
