"""Web servers on loopback that imports and webhooks of a benchmark reach: an honest one, and one that is not.

/file          GET: the bytes that the server was given, at once. POST: 204, and the body is kept with its time.
/slow          announces a megabyte, and sends a byte every two seconds
/endless       announces nothing, and sends 16 kB ten times a second for ever
/later         answers 429, and asks to come back in a day
/hang          takes the request and never answers
"""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class Host:
    """The server. `url` is its address, `posts` what was sent to /file, with the time of arrival."""

    def __init__(self, content: bytes) -> None:
        self.content = content
        self.url = ""
        self.posts: list[tuple[float, Any]] = []

    async def listen(self) -> asyncio.Server:
        """Begin to serve on a free port."""
        server = await asyncio.start_server(self._answer, "127.0.0.1", 0)
        self.url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        return server

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
            method, path, _ = head.split(" ", 2)
            lengths = [
                line.split(":")[1]
                for line in head.lower().split("\r\n")
                if line.startswith("content-length:")
            ]
            body = await reader.readexactly(int(lengths[0])) if lengths else b""
            await self._behave(method, path.split("?")[0], body, writer)
        except (OSError, asyncio.IncompleteReadError):
            pass  # the other side has gone
        except asyncio.CancelledError:
            return  # the program ends; a task that is cancelled would be logged
        finally:
            writer.close()

    async def _behave(self, method: str, path: str, body: bytes, writer: asyncio.StreamWriter) -> None:
        match path:
            case "/slow":
                writer.write(b"HTTP/1.1 200 OK\r\nConnection: close\r\nContent-Length: 1000000\r\n\r\n")
                while True:
                    writer.write(b"x")
                    await writer.drain()
                    await asyncio.sleep(2)
            case "/endless":
                writer.write(b"HTTP/1.1 200 OK\r\nConnection: close\r\n\r\n")
                while True:
                    writer.write(bytes(16_384))
                    await writer.drain()
                    await asyncio.sleep(0.1)
            case "/later":
                writer.write(
                    b"HTTP/1.1 429 Later\r\nConnection: close\r\nRetry-After: 86400\r\nContent-Length: 0\r\n\r\n"
                )
            case "/hang":
                await asyncio.sleep(3600)
            case "/file" if method == "POST":
                self.posts.append((time.time(), json.loads(body)))
                writer.write(b"HTTP/1.1 204 No Content\r\nConnection: close\r\n\r\n")
            case _:
                head = f"HTTP/1.1 200 OK\r\nConnection: close\r\nContent-Length: {len(self.content)}\r\n\r\n"
                writer.write(head.encode() + self.content)
        await writer.drain()


@contextmanager
def serving(content: bytes) -> Iterator[Host]:
    """Serve from a thread."""
    host, ready, stop = Host(content), threading.Event(), asyncio.Event()
    loop: asyncio.AbstractEventLoop | None = None

    async def run() -> None:
        nonlocal loop
        loop = asyncio.get_running_loop()
        server = await host.listen()
        ready.set()
        await stop.wait()
        server.close()

    thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
    thread.start()
    ready.wait()
    try:
        yield host
    finally:
        assert loop is not None
        loop.call_soon_threadsafe(stop.set)
        thread.join()
