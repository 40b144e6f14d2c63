"""Responses with stored files: ETag, If-None-Match, Range and HEAD (RFC 9110). Files are streamed."""

import re
from datetime import UTC
from email.utils import format_datetime
from urllib.parse import quote

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from splatmill.backplane.storage.errors import StorageChangedError
from splatmill.backplane.storage.storage import Entry, Storage, joined
from splatmill_server.base.problems import ProblemError

_RANGE = re.compile(r"\s*bytes\s*=\s*([0-9]{0,19})-([0-9]{0,19})\s*", re.ASCII | re.IGNORECASE)
"""A single range of bytes. Some clients name the largest integer of 64 bits for the end of the file."""

_LOOKS = 3
"""How often a file is looked up that is replaced each time before it is read."""


async def file_response(
    request: Request,
    storage: Storage,
    path: str,
    media_type: str,
    *,
    download_name: str | None = None,
) -> Response:
    """Return a response with the file at `path`, or with the requested range of it.

    With `download_name`, browsers save the file under that name. A file that is replaced before its first byte was
    read, as previews are, is looked up again. Raises a 404 problem if there is no such file, and a 416 problem for a
    range outside of it.
    """
    for left in reversed(range(_LOOKS)):
        try:
            return await _response(request, storage, path, media_type, download_name)
        except StorageChangedError:
            if not left:
                raise
    raise AssertionError("the last look returns or raises")


async def _response(
    request: Request, storage: Storage, path: str, media_type: str, download_name: str | None
) -> Response:
    """Return the response for the file as it is now. Raises StorageChangedError if it is replaced meanwhile."""
    entry = await run_in_threadpool(storage.head, path)
    if entry is None:
        raise ProblemError("file_not_found", f"There is no file at {request.url.path}.")
    etag = f'"{entry.etag}"'
    headers = {
        "ETag": etag,
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, no-cache",  # revalidated on each use; 304 if unchanged
        "Last-Modified": format_datetime(entry.modified.astimezone(UTC), usegmt=True),
        "Content-Type": media_type,
    }
    if download_name is not None:
        headers["Content-Disposition"] = attachment(download_name)
    if media_type.startswith("text/html"):
        # A report contains file names chosen by users, so its page gets no access to this origin.
        headers["Content-Security-Policy"] = "sandbox allow-scripts"
    if matches(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    span = None
    if request.headers.get("if-range", etag) == etag:
        span = _range(request.headers.get("range"), entry, headers)
    start, end = span or (0, entry.size)
    headers["Content-Length"] = str(end - start)
    if span is not None:
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{entry.size}"
    status = 200 if span is None else 206
    if request.method == "HEAD" or start == end:
        return Response(status_code=status, headers=headers)
    whole = start == 0 and end == entry.size
    chunks = storage.stream_get(entry.path, start, None if whole else end, entry.version)
    try:
        first = await anext(chunks)
    except FileNotFoundError:
        raise ProblemError("file_not_found", f"There is no file at {request.url.path}.") from None
    return StreamingResponse(joined(first, chunks), status, headers)


def attachment(name: str) -> str:
    """Return the Content-Disposition of a file that browsers are to save under this name (RFC 6266)."""
    return f"attachment; filename*=UTF-8''{quote(name, safe='')}"


def matches(header: str | None, etag: str) -> bool:
    if header is None:
        return False
    tags = [tag.strip().removeprefix("W/") for tag in header.split(",")]
    return "*" in tags or etag in tags


def _range(header: str | None, entry: Entry, headers: dict[str, str]) -> tuple[int, int] | None:
    """Return the bytes [start, end) of a single range. Return None without a range, and for several ranges or a
    malformed one, which a server may ignore (RFC 9110)."""
    match = _RANGE.fullmatch(header or "")
    if match is None or not any(match.groups()):
        return None
    first, last = (int(text) if text else None for text in match.groups())
    size = entry.size
    if first is None:
        start, end = max(size - (last or 0), 0), size
    elif last is None or last >= first:
        start, end = first, size if last is None else min(last + 1, size)
    else:
        return None
    if start >= size or start >= end:
        raise ProblemError(
            "range_not_satisfiable",
            f"The range {header!r} is outside the file, which has {size} bytes.",
            facts={"size": size},
            headers={"Content-Range": f"bytes */{size}", "ETag": headers["ETag"]},
        )
    return start, end
