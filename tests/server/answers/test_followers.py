"""Many who follow the events of jobs: each is told everything once, and all of them share one connection to Redis.

Not proved here: a thousand of them, and seconds (`splatmill bench capacity` measures both).
"""

import asyncio
import json
from collections.abc import Sequence
from typing import Any

import httpx
import pytest
import redis

from splatmill.backplane import events, keys
from splatmill.backplane.connection import connect_async
from splatmill.schema import JobState, LogEvent, ProgressEvent, StateEvent
from splatmill_server import feed
from splatmill_server.feed import Batch, Feed
from tests.support.served_app import Serve, ServedApp, problem
from tests.support.server_events import brief, follow
from tests.support.waiting import wait_for

FOLLOWERS = 150
"""More than an asyncio client of redis has connections by default."""


async def _follow(http: httpx.AsyncClient, job_id: str) -> list[dict[str, Any]]:
    async with http.stream("GET", f"/v1/jobs/{job_id}/events") as answer:
        assert answer.status_code == 200
        return [
            json.loads(line.removeprefix("data: "))
            async for line in answer.aiter_lines()
            if line.startswith("data: ")
        ]


async def followed(app: ServedApp, job_ids: Sequence[str], act: Any) -> list[list[dict[str, Any]]]:
    """What followers of these jobs are told, while `act` runs in a thread once all of them are there."""
    limits = httpx.Limits(max_connections=None)
    base = str(app.http.base_url)
    async with httpx.AsyncClient(base_url=base, limits=limits, timeout=60, trust_env=False) as http:
        tasks = [asyncio.create_task(_follow(http, job_id)) for job_id in job_ids]
        await asyncio.to_thread(wait_for, lambda: app.service.feed.followers == len(job_ids), 30)
        await asyncio.to_thread(act)
        return await asyncio.gather(*tasks)


def readers(connection: redis.Redis) -> int:
    """Number of connections that wait for entries of streams."""
    clients: Any = connection.client_list()
    return sum(client["cmd"] == "xread" and "b" in client["flags"] for client in clients)


def test_many_followers_of_several_jobs_share_one_reader(app: ServedApp) -> None:
    capture = app.capture()
    jobs = [app.job(capture) for _ in range(3)]
    for job_id in jobs:
        app.begin(job_id)
        app.say(job_id, LogEvent(message="before anybody follows"))

    def act() -> None:
        assert wait_for(lambda: readers(app.redis)) == 1
        for job_id in jobs:
            app.say(job_id, StateEvent(state=JobState.training))
            app.say(job_id, *(ProgressEvent(stage="training", done=n) for n in range(1, 4)))
            app.say(job_id, StateEvent(state=JobState.succeeded))

    found = asyncio.run(followed(app, [jobs[n % 3] for n in range(FOLLOWERS)], act))
    expected = ["queued", "preparing", "log", "training", 1, 2, 3, "succeeded"]
    assert [brief(told) for told in found] == [expected] * FOLLOWERS
    wait_for(lambda: app.service.feed.followers == 0)
    clients: Any = app.redis.client_list()
    assert len(clients) < 60
    wait_for(lambda: readers(app.redis) == 0)


def test_more_followers_than_the_process_takes_are_told_why(serve: Serve) -> None:
    app = serve(max_event_streams=2)
    job_id = app.job()

    def act() -> None:
        refused = problem(app.http.get(f"/v1/jobs/{job_id}/events"), 503, "too_many_followers")
        assert refused["facts"] == {"followers": 2, "limit": 2}
        assert "SPLATMILL_MAX_EVENT_STREAMS" in refused["detail"]
        app.http.post(f"/v1/jobs/{job_id}/cancel")

    found = asyncio.run(followed(app, [job_id] * 2, act))
    assert [brief(told) for told in found] == [["queued", "cancelled"]] * 2
    wait_for(lambda: app.service.feed.followers == 0)
    assert brief(follow(app, job_id)) == ["queued", "cancelled"]


def test_a_follower_that_comes_later_misses_nothing_and_hears_nothing_twice(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)

    def act() -> None:
        for number in range(1, 40):
            app.say(job_id, ProgressEvent(stage="training", done=number))
            if number % 10 == 0:
                known = app.service.feed.followers
                loop.call_soon_threadsafe(later)
                wait_for(lambda: app.service.feed.followers > known)  # noqa: B023  # called at once
        app.say(job_id, StateEvent(state=JobState.failed))

    more: list[asyncio.Task[list[dict[str, Any]]]] = []
    loop: asyncio.AbstractEventLoop

    def later() -> None:
        more.append(loop.create_task(alone()))

    async def alone() -> list[dict[str, Any]]:
        async with httpx.AsyncClient(base_url=str(app.http.base_url), timeout=60, trust_env=False) as http:
            return await _follow(http, job_id)

    async def both() -> list[list[dict[str, Any]]]:
        nonlocal loop
        loop = asyncio.get_running_loop()
        first = await followed(app, [job_id], act)
        return first + list(await asyncio.gather(*more))

    expected = ["queued", "preparing", *range(1, 40), "failed"]
    assert [brief(told) for told in asyncio.run(both())] == [expected] * 4


def test_a_follower_that_is_too_slow_reads_again_what_it_has_missed(
    connection: redis.Redis, redis_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed, "_LONGEST_QUEUE", 2)
    job_id = "job00001"
    connection.hset(keys.job(job_id), "id", job_id)
    start = [events.START] * len(events.BOUNDS)

    def say(number: int) -> None:
        events.append(connection, job_id, 1, 1, ProgressEvent(stage="x", done=number))

    def told(batch: Batch) -> list[int]:
        return [stored.event.done for stored, _ in batch.found if isinstance(stored.event, ProgressEvent)]

    async def slow() -> None:
        client = connect_async(redis_url)
        reader = Feed(client)
        subscription = reader.subscribe(job_id)
        batch, live = await reader.catch_up(subscription, start)
        assert (told(batch), live) == ([], True)
        for number in range(6):
            read = reader._followed[job_id].entries
            say(number)
            while reader._followed[job_id].entries == read:  # the reader passes each on by itself
                await asyncio.sleep(0.01)
        assert subscription.missed
        batch, live = await reader.catch_up(subscription, start)
        assert (told(batch), live) == ([0, 1, 2, 3, 4, 5], True)
        reader.close(subscription)
        await reader.stop()
        await client.aclose()

    asyncio.run(slow())
