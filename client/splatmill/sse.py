"""Server-sent events, and following a job's events across lost connections.

Lines are split on bytes: JSON may hold U+2028 or U+0085, which text splitting takes for ends of lines.
"""

import asyncio
import time
from collections.abc import AsyncIterable, AsyncIterator
from dataclasses import dataclass

import httpx
from pydantic import ValidationError

from splatmill.connection import Connection, pause
from splatmill.errors import Unavailable
from splatmill.schema.events import EventRecord

PATIENCE = 300.0  # seconds without a word before a job is given up on: replacing a server may take that long
# The server sends a comment every few seconds; silence for this long is a dead connection.
SILENCE = httpx.Timeout(30.0, connect=10.0, read=45.0)


@dataclass(frozen=True)
class Message:
    """One dispatched message of an event stream."""

    id: str | None
    data: str


async def read_messages(chunks: AsyncIterable[bytes]) -> AsyncIterator[Message]:
    """The messages of a `text/event-stream` body (WHATWG HTML, section 9.2); comments and `retry` are passed over."""
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
    """Lines without their ends (LF, CRLF or CR); an unfinished last line is dropped, as the standard asks."""
    rest = b""
    async for chunk in chunks:
        rest += chunk
        # A CR at the very end may be the first half of a CRLF: keep it until more is known.
        held = b"\r" if rest.endswith(b"\r") else b""
        text = rest[: len(rest) - len(held)].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        *lines, rest = text.split(b"\n")
        rest += held
        for line in lines:
            yield line


async def follow(
    connection: Connection, path: str, *, after: str | None = None, patience: float = PATIENCE
) -> AsyncIterator[EventRecord]:
    """The events at `path` until the server ends the stream, going on after the last one when the connection breaks.

    `after` is the id to go on after. An event of a kind this version does not know is passed over. Raises
    ConnectionFailed when nothing was heard for `patience` seconds over all tries, and `Refused` for a refusal that
    waiting does not mend. The caller decides whether an ended stream means an ended job.
    """
    heard, tries = time.monotonic(), 0
    while True:
        tries += 1
        try:
            headers = {"Accept": "text/event-stream", "Cache-Control": "no-store"}
            if after is not None:
                headers["Last-Event-ID"] = after
            async with connection.stream("GET", path, headers=headers, timeout=SILENCE) as response:
                heard, tries = time.monotonic(), 0
                async for message in read_messages(response.aiter_bytes()):
                    heard = time.monotonic()
                    after = message.id or after
                    try:
                        record = EventRecord.model_validate_json(message.data)
                    except ValidationError:
                        continue
                    yield record
            return
        except httpx.TransportError as error:
            if time.monotonic() - heard > patience:
                raise connection.lost(error) from error
        except Unavailable:
            if time.monotonic() - heard > patience:
                raise
        await asyncio.sleep(pause(tries))
