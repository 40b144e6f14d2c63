"""A scripted HTTP server on a real socket, for what a well-behaved server never does: dropping connections, answering
half a file, being busy."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field

import pytest

from splatmill.loop import BackgroundLoop


@dataclass
class Seen:
    """A request that reached the server."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes


@dataclass
class Reply:
    """What is sent back. `cut` bytes of the body are announced and then withheld by closing the connection."""

    status: int = 200
    body: bytes = b"{}"
    headers: dict[str, str] = field(default_factory=dict)
    cut: int = 0
    dropped: bool = False  # close without any answer

    def encode(self) -> bytes:
        if self.dropped:
            return b""
        headers = {"Content-Length": str(len(self.body)), "Connection": "close"} | self.headers
        head = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
        sent = self.body[: len(self.body) - self.cut]
        return f"HTTP/1.1 {self.status} Scripted\r\n{head}\r\n".encode() + sent


@dataclass
class Peer:
    """The server: `answer` is asked for every request, `seen` is what came."""

    url: str = ""
    seen: list[Seen] = field(default_factory=list)
    answer: Callable[[Seen], Reply | Awaitable[Reply]] = lambda _: Reply()

    def script(self, *replies: Reply) -> None:
        """Answer with these, one after another."""
        rest = iter(replies)
        self.answer = lambda _: next(rest)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = (await reader.readuntil(b"\r\n\r\n")).decode()
        first, *lines = head.strip().split("\r\n")
        method, path, _ = first.split(" ")
        headers = {name.lower(): value.strip() for name, value in (line.split(":", 1) for line in lines)}
        body = await reader.readexactly(int(headers.get("content-length", 0)))
        request = Seen(method, path, headers, body)
        self.seen.append(request)
        reply = self.answer(request)
        writer.write((await reply if isinstance(reply, Awaitable) else reply).encode())
        await writer.drain()
        writer.close()
        await writer.wait_closed()


@pytest.fixture
def peer() -> Iterator[Peer]:
    loop = BackgroundLoop()
    peer = Peer()

    async def start() -> asyncio.Server:
        return await asyncio.start_server(peer.serve, "127.0.0.1", 0)

    async def stop(server: asyncio.Server) -> None:
        server.close()
        await server.wait_closed()

    server = loop.run(start())
    peer.url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    yield peer
    loop.run(stop(server))
    loop.close()


@pytest.fixture
def reply() -> type[Reply]:
    return Reply


@pytest.fixture(autouse=True)
def _no_settings_of_the_person(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SPLATMILL_SERVER", raising=False)
    monkeypatch.delenv("SPLATMILL_API_KEY", raising=False)


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    # Not a mock: the same code waits, for milliseconds, so that the tests stay quick.
    monkeypatch.setattr("splatmill.connection.FIRST_PAUSE", 0.002)
