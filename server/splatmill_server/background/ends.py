"""Announces the end of a job as soon as its worker has reported it, before the reaper looks.

Redis gives each end to one of the API processes. An end that is lost with a process, or while Redis or storage does not
answer, is found by the reaper.
"""

import asyncio
from typing import Any, cast

import redis
import structlog
from redis.asyncio import Redis as AsyncRedis
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import keys
from splatmill_server.base.feed import answering
from splatmill_server.jobs.records import Jobs

log = structlog.get_logger()

_WAIT = 5.0
"""Seconds that Redis waits for an end before it answers that there is none."""

_LATE = 10.0
"""Seconds after that without an answer, after which the connection counts as broken."""

_PAUSE = 1.0
"""Seconds to wait where Redis cannot be reached."""


class Ends:
    """The loop that waits for ends of jobs."""

    def __init__(self, connection: AsyncRedis, jobs: Jobs) -> None:
        self._connection = connection
        self._jobs = jobs

    async def run(self) -> None:
        """Retire jobs that have ended until this task is cancelled."""
        while True:
            try:
                async with answering(_WAIT + _LATE):
                    end = await cast(Any, self._connection.brpop([keys.ENDS], timeout=_WAIT))
                if end is not None:
                    await run_in_threadpool(self._jobs.retire, end[1].decode())
            except redis.RedisError as error:
                log.warning("the ends of jobs cannot be read", error=str(error))
                await asyncio.sleep(_PAUSE)
            except Exception:
                log.exception("the end of a job waits for the reaper")
