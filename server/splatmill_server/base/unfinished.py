"""Work resumed after a restart: each piece has a mark in storage until it has ended. Any API process takes it up.

The name of a mark is made of ids with dots between them. Pieces wait in lines, one for each owner, which take turns. A
piece that waits for something else, such as a pause before another attempt, holds no slot meanwhile.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress

import redis
import structlog
from starlette.concurrency import run_in_threadpool

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill_server.base import cancelling
from splatmill_server.base.leases import keep_for, lease
from splatmill_server.base.turns import Turns

log = structlog.get_logger()

DELETED_SECONDS = 3.0
"""Seconds after which it is noticed that another process has deleted what a piece belongs to."""


class Unfinished:
    """The pieces of one kind of work that have not ended, and the tasks of this process that work on them.

    kind: what the leases in Redis, which keep two processes from one piece, and the log call a piece.
    folder: the folder of the marks in storage.
    work: works on the piece with this name of a mark, and removes the mark at its end. It returns None then, or the
        seconds to wait before it is called again. Cancelled, it is called again later.
    line: returns the line of a piece, which never changes; called in a thread.
    exists: returns whether what a piece belongs to is still there; called in a thread. If it was deleted, the work is
        cancelled, and called once more to remove what is left.
    turns: how many pieces this process works on at once, in all and of one line.
    look_seconds: time between two looks for pieces that another process has left.
    """

    def __init__(
        self,
        connection: redis.Redis,
        storage: Storage,
        kind: str,
        folder: str,
        work: Callable[[str], Awaitable[float | None]],
        *,
        line: Callable[[str], str],
        exists: Callable[[str], bool],
        turns: Turns,
        look_seconds: float,
    ) -> None:
        self._connection = connection
        self._storage = storage
        self._kind = kind
        self._folder = folder
        self._work = work
        self._line = line
        self._exists = exists
        self._turns = turns
        self._look_seconds = look_seconds
        self._wake = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        # By name of a mark: its line; when it may be taken up again; the task with its lease; the work itself.
        self._lines: dict[str, str] = {}
        self._resting: dict[str, float] = {}
        self.running: dict[str, asyncio.Task[None]] = {}
        self._working: dict[str, asyncio.Task[float | None]] = {}

    def wake(self) -> None:
        """Look for new pieces now."""
        self._wake.set()

    def cancel(self, belongs: Callable[[str], bool]) -> None:
        """Cancel the work on the pieces for which `belongs` is true, whose record was deleted. Any thread may call."""
        if self._loop is not None:
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._cancel, belongs)

    def _cancel(self, belongs: Callable[[str], bool]) -> None:
        for name, task in self._working.items():
            if belongs(name):
                task.cancel()
        for name in [name for name in self._resting if belongs(name)]:
            del self._resting[name]
        self.wake()

    def line_of(self, name: str) -> str:
        """Return the line of a piece. Any thread may call. Raises StorageError."""
        line = self._lines.get(name)
        if line is None:
            line = self._lines[name] = self._line(name)
        return line

    async def run(self) -> None:
        """Take up what has not ended until this task is cancelled."""
        self._loop = asyncio.get_running_loop()
        try:
            while True:
                self._wake.clear()
                try:
                    await self._take_up()
                except (StorageError, redis.RedisError) as error:
                    log.warning("unfinished work cannot be looked for", kind=self._kind, error=str(error))
                except Exception:
                    log.exception("unfinished work cannot be looked for", kind=self._kind)
                with suppress(TimeoutError):
                    async with asyncio.timeout(self._look_seconds):
                        await self._wake.wait()
        finally:
            await cancelling.end(*self.running.values())

    async def _take_up(self) -> None:
        """Begin as many pieces as may run at once, of each line those that were asked for first."""
        lines, now = await run_in_threadpool(self._marked), time.monotonic()
        self._resting = {
            name: until for name, until in self._resting.items() if name in lines and until > now
        }
        waiting = [
            (line, name)
            for name, line in lines.items()
            if name not in self.running and name not in self._resting
        ]
        working = [self._lines.get(name, "") for name in self.running]
        for name in self._turns.choose(working, waiting):
            self.running[name] = asyncio.create_task(self._run(name))

    def _marked(self) -> dict[str, str]:
        """Return the lines of all pieces by their names, in the order in which they were asked for."""
        marks = sorted(self._storage.entries(self._folder), key=lambda entry: entry.modified)
        names = [entry.path.rsplit("/", 1)[-1] for entry in marks]
        marked = {
            name: self.line_of(name) for name in names if all(layout.is_id(part) for part in name.split("."))
        }
        running = [*self.running]  # copied at once: the event loop changes it meanwhile
        self._lines = marked | {name: self._lines[name] for name in running if name in self._lines}
        return marked

    async def _run(self, name: str) -> None:
        rest = self._look_seconds  # where another process works on it, or nobody can now
        try:
            async with lease(self._connection, self._kind, name) as mine:
                if mine and (rest := await self._worked(name) or 0.0):
                    await keep_for(self._connection, self._kind, name, rest)
        except (StorageError, redis.RedisError) as error:
            log.warning("unfinished work waits", kind=self._kind, name=name, error=str(error))
        except Exception:
            log.exception("unfinished work waits", kind=self._kind, name=name)
        finally:
            self.running.pop(name, None)
            self._resting[name] = time.monotonic() + rest
            asyncio.get_running_loop().call_later(rest, self.wake)
            self.wake()  # for the next one that waits

    async def _worked(self, name: str) -> float | None:
        """Work on a piece, and cancel it once what it belongs to is deleted. Return the seconds to wait, or None."""
        task = self._working[name] = asyncio.ensure_future(self._work(name))
        try:
            while not (await asyncio.wait({task}, timeout=DELETED_SECONDS))[0]:
                with suppress(StorageError):
                    if not await run_in_threadpool(self._exists, name):
                        task.cancel()
        finally:
            self._working.pop(name, None)
            await cancelling.end(task)
        return await self._work(name) if task.cancelled() else task.result()
