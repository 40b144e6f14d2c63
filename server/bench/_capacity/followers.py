"""Many clients that follow the events of one job on one API process."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import httpx
import psutil

from splatmill.backplane.connection import connect
from splatmill.backplane.jobs import events
from splatmill.schema import JobState, LogEvent, ProgressEvent, StateEvent

EVENTS = 40
"""Events that are appended while all clients follow, four a second as a training appends them."""

_PAUSE = 0.25


@dataclass(frozen=True)
class Served:
    """An API process, the unix socket that it listens on, and a client of it."""

    http: httpx.Client
    socket: Path
    process: psutil.Process


def follow_all(served: Served, redis_url: str, count: int) -> dict[str, Any]:
    """Let `count` clients follow a queued job to its end; return how many were told everything, and what it took."""
    process = served.process
    with connect(redis_url) as connection:
        job_id = _queued(served.http)
        number = events.begin_attempt(connection, job_id)
        events.append(connection, job_id, 1, number, StateEvent(state=JobState.training))

        def act() -> tuple[int, int]:
            for step in range(EVENTS):
                events.append(connection, job_id, 1, number, ProgressEvent(stage="training", done=step))
                time.sleep(_PAUSE)
            held = len(cast(list[Any], connection.client_list()))
            memory = process.memory_info().rss
            events.append(connection, job_id, 1, number, LogEvent(message="the end"))
            events.append(connection, job_id, 1, number, StateEvent(state=JobState.failed))
            return held, memory

        before, busy = process.memory_info().rss, sum(process.cpu_times()[:2])
        began = time.perf_counter()
        streams, (held, memory) = asyncio.run(_follow_all(str(served.socket), job_id, count, act))
        seconds = time.perf_counter() - began
    whole = sum(told == streams[0] and told[-1:] == ["failed"] for told in streams)
    return {
        "followers": count,
        "told_everything": whole,
        "seconds": seconds,
        "event_seconds": EVENTS * _PAUSE,
        "cpu_seconds": sum(process.cpu_times()[:2]) - busy,
        "redis_connections": held,
        "bytes_each": (memory - before) / count,
    }


async def _follow_all(
    socket: str, job_id: str, count: int, act: Callable[[], tuple[int, int]]
) -> tuple[list[list[str]], tuple[int, int]]:
    transport = httpx.AsyncHTTPTransport(uds=socket, limits=httpx.Limits(max_connections=None))
    following = asyncio.Semaphore(0)
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost", timeout=600) as http:

        async def follow() -> list[str]:
            told = []
            async with http.stream("GET", f"/v1/jobs/{job_id}/events") as answer:
                following.release()
                async for line in answer.aiter_lines():
                    if line.startswith("event: "):
                        told.append(line)
                    elif '"state":"failed"' in line:
                        told.append("failed")
            return told

        tasks = [asyncio.create_task(follow()) for _ in range(count)]
        for _ in range(count):
            await following.acquire()
        done = await asyncio.to_thread(act)
        return await asyncio.gather(*tasks), done


def _queued(http: httpx.Client) -> str:
    listed = http.get("/v1/jobs", params={"state": "queued", "limit": 1}).raise_for_status().json()["jobs"]
    return str(listed[0]["id"])
