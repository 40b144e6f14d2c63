"""Parsing of server-sent events, and a stream of a job's events that survives lost connections.

Lines are split as bytes: JSON may contain U+2028 or U+0085, at which str.splitlines would break a line.
"""

import asyncio
import time
from collections.abc import AsyncGenerator, AsyncIterable, AsyncIterator
from dataclasses import dataclass

import httpx
from pydantic import ValidationError

from splatmill.errors import Unavailable
from splatmill.schema.headers import read_token
from splatmill.schema.resources.jobs.events import EventRecord
from splatmill.transfer.connection import LONGEST_WISH, Connection, backoff

GIVE_UP_SECONDS = 300.0
"""Time without any data after which the connection counts as lost for good; replacing a server may take this long."""

# The server sends a comment every few seconds, so a read that waits this long has a dead connection.
STREAM_TIMEOUT = httpx.Timeout(30.0, connect=10.0, read=45.0)


@dataclass(frozen=True)
class Message:
    """One message of an event stream: its `id`, if it has one, and its `data`."""

    id: str | None
    data: str


async def read_messages(chunks: AsyncIterable[bytes]) -> AsyncIterator[Message]:
    """Yield the messages of a `text/event-stream` body (WHATWG HTML, section 9.2); comments and `retry` are ignored."""
    last_id: str | None = None
    data: list[str] = []
    async for line in _lines(chunks):
        if not line:
            if data:
                yield Message(last_id, "\n".join(data))
            data = []
            continue
        name, _, value = line.decode("utf-8", "replace").partition(":")
        value = value.removeprefix(" ")
        if name == "data":
            data.append(value)
        elif name == "id" and "\0" not in value:
            last_id = value


async def _lines(chunks: AsyncIterable[bytes]) -> AsyncIterator[bytes]:
    """Yield lines without their ends (LF, CRLF or CR). An unfinished last line is dropped, as the standard requires."""
    rest = b""
    async for chunk in chunks:
        rest += chunk
        # A CR at the end may be the first half of a CRLF, so it is kept for the next chunk.
        held = b"\r" if rest.endswith(b"\r") else b""
        text = rest[: len(rest) - len(held)].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        *lines, rest = text.split(b"\n")
        rest += held
        for line in lines:
            yield line


async def follow_events(
    connection: Connection, path: str, *, after: str | None = None, give_up: float = GIVE_UP_SECONDS
) -> AsyncGenerator[EventRecord, None]:
    """Yield the events at `path` until the server ends the stream; after a lost connection, resume after the last one.

    `after` is the id of the last event already seen. Events of a type that this version does not know are skipped. The
    end of the stream does not imply the end of the job.

    Raises ConnectionFailed or Unavailable when no data arrived for `give_up` seconds over all attempts, and other
    subclasses of `Refused` at once.
    """
    heard, tries = time.monotonic(), 0

    async def noted(chunks: AsyncIterable[bytes]) -> AsyncIterator[bytes]:
        # A comment, which the server sends while nothing happens, shows as well that the connection lives.
        nonlocal heard
        async for chunk in chunks:
            heard = time.monotonic()
            yield chunk

    while True:
        tries += 1
        wish = 0.0  # seconds that the server asks to wait
        try:
            headers = {"Accept": "text/event-stream", "Cache-Control": "no-store"}
            if after is not None:
                headers["Last-Event-ID"] = after
            async with connection.stream("GET", path, headers=headers, timeout=STREAM_TIMEOUT) as response:
                heard, tries = time.monotonic(), 0
                async for message in read_messages(noted(response.aiter_bytes())):
                    after = read_token(message.id) or after
                    try:
                        record = EventRecord.model_validate_json(message.data)
                    except ValidationError:
                        continue
                    yield record
            return
        except httpx.TransportError as error:
            if time.monotonic() - heard > give_up:
                raise connection.lost(error) from error
        except Unavailable as error:
            if time.monotonic() - heard > give_up:
                raise
            wish = min(error.retry_after or 0.0, LONGEST_WISH)
        await asyncio.sleep(max(backoff(tries), wish))
