"""A proxy in front of a bucket, which counts its requests and spoils those that a test chooses: no answer, a cut
connection, half an answer, or a status of the server's own."""

import asyncio
import contextlib
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal
from urllib.parse import urlsplit

import pytest

from splatmill.sdk.loop import BackgroundLoop
from tests.support.servers.bucket import bucket

Fault = Literal["stall", "wait", "cut", "deaf"] | int | None
"""What happens to a request. None: it is passed on. "stall": it gets no answer, and `release` cuts its connection.
"wait": it is passed on by `release`. "cut": the connection
is closed without an answer. "deaf": it is passed on, and the connection closed in place of the answer. 500 to 599: an
answer with this status."""


@dataclass(frozen=True)
class Request:
    """A request to the bucket. `path` is the address with the query."""

    method: str
    path: str
    headers: dict[str, str]


@dataclass
class FaultyS3:
    """The proxy.

    storage: the address of a folder in the bucket, for `Storage`.
    requests: the requests so far.
    fault: chooses what happens to a request.
    stalled: number of requests that are held up.
    half: chooses how many bytes of the body of an answer are passed on before the connection is cut, or None: all.
    """

    storage: str = ""
    requests: list[Request] = field(default_factory=list)
    fault: Callable[[Request], Fault] = lambda _: None
    half: Callable[[Request], int | None] = lambda _: None
    stalled: int = 0
    _writers: set[asyncio.StreamWriter] = field(default_factory=set)
    _tasks: set[asyncio.Task[None]] = field(default_factory=set)
    _released: asyncio.Event = field(default_factory=asyncio.Event)
    _loop: BackgroundLoop | None = None

    def reset(self) -> None:
        """Spoil nothing from now on, and forget what was seen."""
        self.release()
        self.fault, self.half, self.requests = (lambda _: None), (lambda _: None), []

    @property
    def untaken(self) -> int:
        """Bytes of answers that the process which asked has not taken yet."""
        return sum(writer.transport.get_write_buffer_size() for writer in set(self._writers))

    def release(self) -> None:
        """End the wait of all requests that are held up."""

        async def let_go() -> None:
            self._released.set()
            self._released = asyncio.Event()

        assert self._loop is not None
        self._loop.run(let_go())

    def first(self, count: int, fault: Fault, method: str = "") -> None:
        """Spoil the first requests that come, of one method or of all."""
        left = count

        def choose(request: Request) -> Fault:
            nonlocal left
            if left and request.method.startswith(method):
                left -= 1
                return fault
            return None

        self.fault = choose

    def _begin(
        self, upstream: tuple[str, int], reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        task = asyncio.create_task(self._serve(upstream, reader, writer))
        self._tasks.add(task)  # the loop itself does not keep it
        task.add_done_callback(self._tasks.discard)

    async def _serve(
        self, upstream: tuple[str, int], reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError), contextlib.closing(writer):
            head = await reader.readuntil(b"\r\n\r\n")
            method, path, _ = head.split(b"\r\n")[0].decode().split(" ")
            pairs = (line.split(":", 1) for line in head.decode().strip().split("\r\n")[1:])
            headers = {name.lower(): value.strip() for name, value in pairs}
            body = await reader.readexactly(int(headers.get("content-length", 0)))
            request = Request(method, path, headers)
            self.requests.append(request)
            fault = self.fault(request)
            if fault in ("stall", "wait"):
                self.stalled += 1
                await self._released.wait()
                self.stalled -= 1
            if fault == "stall":
                return
            if isinstance(fault, int):
                writer.write(
                    f"HTTP/1.1 {fault} Spoilt\r\nConnection: close\r\nContent-Length: 0\r\n\r\n".encode()
                )
                await writer.drain()
            elif fault != "cut":
                await self._pass_on(upstream, request, head, body, None if fault == "deaf" else writer)

    async def _pass_on(
        self,
        upstream: tuple[str, int],
        request: Request,
        head: bytes,
        body: bytes,
        writer: asyncio.StreamWriter | None,
    ) -> None:
        answers, server = await asyncio.open_connection(*upstream)
        with contextlib.closing(server):
            server.write(_closing(head) + body)
            await server.drain()
            answer = _closing(await answers.readuntil(b"\r\n\r\n"))
            # A HEAD request gets the length of a body that does not follow.
            rest = b"" if request.method == "HEAD" else await answers.read()
            if writer is not None:
                self._writers.add(writer)
                writer.write(answer + rest[: self.half(request)])
                try:
                    await writer.drain()
                finally:
                    self._writers.discard(writer)


def _closing(head: bytes) -> bytes:
    """Return the head of a message that ends its connection."""
    kept = re.sub(rb"(?i)\r\nconnection:[^\r]*", b"", head)
    return kept.removesuffix(b"\r\n\r\n") + b"\r\nConnection: close\r\n\r\n"


@contextlib.contextmanager
def faulty_s3() -> Iterator[FaultyS3]:
    """Serve a bucket through a proxy, with the AWS_* variables set to it; skip without moto."""
    with bucket() as storage, pytest.MonkeyPatch.context() as patch:
        proxy, loop = FaultyS3(storage=storage), BackgroundLoop()
        proxy._loop = loop
        address = urlsplit(os.environ["AWS_ENDPOINT_URL"])
        upstream = (address.hostname or "", address.port or 0)

        async def start() -> asyncio.Server:
            return await asyncio.start_server(
                lambda reader, writer: proxy._begin(upstream, reader, writer), "127.0.0.1", 0
            )

        async def stop() -> None:
            server.close()

        server = loop.run(start())
        port = server.sockets[0].getsockname()[1]
        patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
        try:
            yield proxy
        finally:
            proxy.reset()
            loop.run(stop())
            loop.close()
