"""A TCP proxy whose connections can be cut, stalled, or answered with errors, for the way to Redis and to S3."""

import asyncio
import contextlib
import threading
from collections.abc import Callable

_SLOW_DOWN = b"<?xml version='1.0'?><Error><Code>SlowDown</Code><Message>Reduce your rate.</Message></Error>"
_UNAVAILABLE = (
    b"HTTP/1.1 503 Slow Down\r\nContent-Type: application/xml\r\nConnection: close\r\n"
    b"Content-Length: %d\r\n\r\n%s" % (len(_SLOW_DOWN), _SLOW_DOWN)
)


class Proxy:
    """Forwards connections from a free port of this machine to `target`, host and port. It must be closed.

    met: how many connections, pieces or requests the newest fault has met.
    """

    def __init__(self, target: tuple[str, int]) -> None:
        self.target = target
        self.port = 0
        self.met = 0
        self._cut = self._errors = False
        self._links: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        self._flows = asyncio.Event()
        self._flows.set()
        self._thread = threading.Thread(target=self._run, name="proxy", daemon=True)
        self._begun = threading.Event()
        self._thread.start()
        self._begun.wait(10)

    def cut(self) -> None:
        """Reset every connection, and refuse new ones."""

        def now() -> None:
            self._cut = True
            self.met = len(self._links)
            for link in list(self._links):
                link.transport.abort()

        self._call(now)

    def stall(self) -> None:
        """Let no byte through, in either direction. What is sent meanwhile arrives later."""

        def now() -> None:
            self.met = 0
            self._flows.clear()

        self._call(now)

    def fail(self) -> None:
        """Answer every HTTP request with 503, as S3 does when it is asked too much."""

        def now() -> None:
            self.met = 0
            self._errors = True

        self._call(now)

    def heal(self) -> None:
        """Forward everything again."""

        def now() -> None:
            self._cut = self._errors = False
            self._flows.set()

        self._call(now)

    def close(self) -> None:
        """Close every connection and end the thread."""
        self.cut()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10)

    def _call(self, action: Callable[[], object]) -> None:
        done = threading.Event()
        self._loop.call_soon_threadsafe(action)
        self._loop.call_soon_threadsafe(done.set)
        done.wait(10)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(asyncio.start_server(self._serve, "127.0.0.1", 0))
        self.port = server.sockets[0].getsockname()[1]
        self._begun.set()
        self._loop.run_forever()
        server.close()
        tasks = asyncio.all_tasks(self._loop)
        for task in tasks:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        self._loop.run_until_complete(asyncio.sleep(0))  # for the aborted connections to be closed
        self._loop.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._cut:
            self.met += 1
            writer.transport.abort()
            return
        self._links.add(writer)
        try:
            try:
                upstream, onward = await asyncio.open_connection(*self.target)
            except OSError:
                return
            self._links.add(onward)
            try:
                await asyncio.gather(
                    self._pump(reader, onward, writer),
                    self._pump(upstream, writer, None),
                )
            finally:
                self._links.discard(onward)
                onward.transport.abort()
        except (OSError, asyncio.CancelledError):
            pass
        finally:
            self._links.discard(writer)
            writer.transport.abort()

    async def _pump(
        self, source: asyncio.StreamReader, sink: asyncio.StreamWriter, client: asyncio.StreamWriter | None
    ) -> None:
        """Forward until the source ends. `client` is who is answered with errors."""
        while data := await source.read(65536):
            self.met += not self._flows.is_set()
            await self._flows.wait()
            if client is not None and self._errors:
                self.met += 1
                client.write(_UNAVAILABLE)
                with contextlib.suppress(OSError):
                    await client.drain()
                client.close()
                raise ConnectionResetError
            sink.write(data)
            await sink.drain()
        with contextlib.suppress(OSError):
            sink.write_eof()
