"""Work that goes on after a restart: each piece has a mark in storage until it has ended. Any API process takes it up.

The name of a mark is made of ids with dots between them. Pieces whose names begin with the same id wait in one line.
"""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress

import redis
import structlog
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import layout
from splatmill.backplane.storage import Storage, StorageError
from splatmill_server.leases import lease

log = structlog.get_logger()


class Unfinished:
    """The pieces of one kind of work that have not ended, and the tasks of this process that work on them.

    kind: what the leases in Redis, which keep two processes from one piece, and the log call a piece.
    folder: the folder of the marks in storage.
    work: works on the piece with this name of a mark, and removes the mark at its end; cancelled, it is taken up again.
    at_once: pieces that this process works on at once.
    of_line: how many of them wait in one line.
    look_seconds: time between two looks for pieces that another process has left.
    """

    def __init__(
        self,
        connection: redis.Redis,
        storage: Storage,
        kind: str,
        folder: str,
        work: Callable[[str], Awaitable[None]],
        *,
        at_once: int,
        of_line: int,
        look_seconds: float,
    ) -> None:
        self._connection = connection
        self._storage = storage
        self._kind = kind
        self._folder = folder
        self._work = work
        self._at_once = at_once
        self._of_line = of_line
        self._look_seconds = look_seconds
        self._wake = asyncio.Event()
        self.running: dict[str, asyncio.Task[None]] = {}

    def wake(self) -> None:
        """Look for new pieces now."""
        self._wake.set()

    async def run(self) -> None:
        """Take up what has not ended until this task is cancelled."""
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
                    await asyncio.wait_for(self._wake.wait(), self._look_seconds)
        finally:
            tasks = list(self.running.values())
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _take_up(self) -> None:
        """Begin as many pieces as may run at once, those that were asked for first before the others."""
        marks = await run_in_threadpool(lambda: list(self._storage.entries(self._folder)))
        for entry in sorted(marks, key=lambda entry: entry.modified):
            name = entry.path.rsplit("/", 1)[-1]
            if not all(layout.is_id(part) for part in name.split(".")):
                continue
            line = name.partition(".")[0]
            of_line = sum(running.partition(".")[0] == line for running in self.running)
            if len(self.running) < self._at_once and of_line < self._of_line and name not in self.running:
                self.running[name] = asyncio.create_task(self._run(name))

    async def _run(self, name: str) -> None:
        ended = False
        try:
            async with lease(self._connection, self._kind, name) as mine:
                if mine:
                    await self._work(name)
                    ended = True
        except (StorageError, redis.RedisError) as error:
            log.warning("unfinished work waits", kind=self._kind, name=name, error=str(error))
        except Exception:
            log.exception("unfinished work waits", kind=self._kind, name=name)
        finally:
            self.running.pop(name, None)
            if ended:
                self.wake()  # for the next one of this line
