"""A server that answers as a test scripts it: it can drop connections, send half a file, or be busy."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest

from splatmill.sdk.loop import BackgroundLoop


@dataclass
class Request:
    """A request that reached the server."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes


@dataclass
class Reply:
    """A response.

    cut: number of bytes that are announced but not sent, because the connection is closed.
    pace: seconds before each byte of the body; 0 sends it at once.
    """

    status: int = 200
    body: bytes = b"{}"
    headers: dict[str, str] = field(default_factory=dict)
    cut: int = 0
    pace: float = 0.0
    dropped: bool = False  # close the connection without a response

    def encode(self) -> bytes:
        if self.dropped:
            return b""
        headers = {"Content-Length": str(len(self.body)), "Connection": "close"} | self.headers
        head = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
        sent = self.body[: len(self.body) - self.cut]
        return f"HTTP/1.1 {self.status} Scripted\r\n{head}\r\n".encode() + sent


@dataclass
class ScriptedServer:
    """The server: `answer` makes the response to a request, `requests` are the requests so far.

    left: number of clients that closed their connection before the whole response was sent.
    """

    url: str = ""
    requests: list[Request] = field(default_factory=list)
    left: int = 0
    answer: Callable[[Request], Reply | Awaitable[Reply]] = lambda _: Reply()

    def script(self, *replies: Reply) -> None:
        """Answer with these responses, one after another."""
        rest = iter(replies)
        self.answer = lambda _: next(rest)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = (await reader.readuntil(b"\r\n\r\n")).decode()
            first, *lines = head.strip().split("\r\n")
            method, path, _ = first.split(" ")
            headers = {name.lower(): value.strip() for name, value in (line.split(":", 1) for line in lines)}
            body = await reader.readexactly(int(headers.get("content-length", 0)))
        except (asyncio.IncompleteReadError, ConnectionError):
            writer.close()  # it was closed before there was a whole request
            return
        request = Request(method, path, headers, body)
        self.requests.append(request)
        answer = self.answer(request)
        try:
            reply = await answer if isinstance(answer, Awaitable) else answer
            whole = reply.encode()
            begin = whole.index(b"\r\n\r\n") + 4 if reply.pace else len(whole)
            writer.write(whole[:begin])
            await writer.drain()
            for byte in whole[begin:]:
                await asyncio.sleep(reply.pace)
                writer.write(bytes([byte]))
                await writer.drain()
        except ConnectionError:
            self.left += 1
        except asyncio.CancelledError:
            pass  # the server stops; in Python 3.11, asyncio logs a cancelled handler as an error
        finally:
            writer.close()


@contextmanager
def scripted_server() -> Iterator[ScriptedServer]:
    """Run a server on a free port; its `url` is set."""
    loop = BackgroundLoop()
    peer = ScriptedServer()

    async def start() -> asyncio.Server:
        return await asyncio.start_server(peer.serve, "127.0.0.1", 0)

    async def stop(server: asyncio.Server) -> None:
        # Connections that wait for a response are dropped with the loop.
        server.close()

    server = loop.run(start())
    peer.url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    yield peer
    loop.run(stop(server))
    loop.close()


@pytest.fixture
def peer() -> Iterator[ScriptedServer]:
    """A scripted server for one test; a conftest.py that imports it offers it."""
    with scripted_server() as server:
        yield server
