"""An event loop on its own thread, on which the synchronous client runs the asynchronous one."""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any, Final, TypeVar

from splatmill.schema.resources.jobs.events import Progress

T = TypeVar("T")

_DONE: Final = object()


class BackgroundLoop:
    """An event loop on a thread. The thread is a daemon, so a program that does not call `close` still ends."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._open: set[Callable[[], Coroutine[Any, Any, None]]] = set()  # that close iterations
        self._thread = threading.Thread(target=self._serve, name="splatmill", daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_forever()

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Run `work` on the loop and return its result. An exception in the waiting thread (Ctrl-C) cancels `work`."""
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def run_reporting(
        self,
        work: Callable[[Callable[[Progress], None]], Coroutine[Any, Any, T]],
        on_progress: Callable[[Progress], None] | None,
    ) -> T:
        """Run `work(report)` and return its result. `on_progress` is called on the caller's thread with each report."""
        if on_progress is None:
            return self.run(work(lambda _: None))
        reports: SimpleQueue[Any] = SimpleQueue()
        future: Future[T] = asyncio.run_coroutine_threadsafe(work(reports.put), self._loop)
        future.add_done_callback(lambda _: reports.put(_DONE))
        try:
            while (report := reports.get()) is not _DONE:
                on_progress(report)
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def iterate(self, items: AsyncIterator[T]) -> Iterator[T]:
        """Yield the items of an asynchronous generator, which is closed when the iteration ends early."""

        advancing: asyncio.Task[Any] | None = None

        async def advance() -> T | object:
            nonlocal advancing
            advancing = asyncio.current_task()
            return await anext(items, _DONE)

        async def close_items() -> None:
            # An exception may have arrived while the next item was awaited; a running generator cannot be closed.
            if advancing is not None and not advancing.done():
                advancing.cancel()
                await asyncio.wait({advancing})
            close = getattr(items, "aclose", None)
            if close is not None:
                await close()

        self._open.add(close_items)
        try:
            while (item := self.run(advance())) is not _DONE:
                yield item  # type: ignore[misc]  # the default of anext widens the type; _DONE is excluded here
        finally:
            self._close_items(close_items)

    def _close_items(self, close: Callable[[], Coroutine[Any, Any, None]]) -> None:
        # After `close`, which has closed the items, an abandoned iteration may still be collected.
        if close in self._open:
            self._open.discard(close)
            self.run(close())

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._loop.is_closed()

    def close(self) -> None:
        """Close the iterations, cancel the running coroutines, and end the thread."""
        # The loop itself would close all generators at once, and report that one which closes another runs already.
        for close in list(self._open):
            self._close_items(close)
        self.run(_cancel_others())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


async def _cancel_others() -> None:
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)
    await asyncio.get_running_loop().shutdown_asyncgens()
    await asyncio.get_running_loop().shutdown_default_executor()
