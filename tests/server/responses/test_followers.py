"""Many who follow the events of jobs: each is told everything once, and all of them share one connection to Redis.

What one of them sends as its position changes nothing for the others, and neither does a Redis that was restored.

Not proved here: a thousand of them, and seconds (`splatmill bench capacity` measures both).
"""

import asyncio
import json
from collections.abc import Sequence
from typing import Any

import httpx
import pytest
import redis
from starlette.datastructures import Headers

from splatmill.backplane import keys
from splatmill.backplane.connection import connect_async
from splatmill.backplane.jobs import events
from splatmill.schema import JobState, LogEvent, ProgressEvent, StateEvent
from splatmill_server.access.caller import Caller
from splatmill_server.base import feed
from splatmill_server.base.feed import Batch, Feed, Subscription
from tests.support.served_app import Serve, ServedApp, problem
from tests.support.servers.server_events import brief, follow
from tests.support.waiting import wait_for

FOLLOWERS = 150
"""More than an asyncio client of redis has connections by default."""


FAR = "9999999999999999999-0"
"""An entry's id that no stream reaches."""

NONE = "_0-0" * 3
"""Ids before the first entries of the streams of lines and metrics."""


async def _follow(http: httpx.AsyncClient, job_id: str, after: str | None = None) -> list[dict[str, Any]]:
    headers = {"Last-Event-ID": after} if after is not None else {}
    async with http.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers) as answer:
        assert answer.status_code == 200
        return [
            json.loads(line.removeprefix("data: "))
            async for line in answer.aiter_lines()
            if line.startswith("data: ")
        ]


async def followed(
    app: ServedApp, job_ids: Sequence[str], act: Any, after: Sequence[str | None] | None = None
) -> list[list[dict[str, Any]]]:
    """What followers of these jobs are told, while `act` runs in a thread once all of them are there.

    after: the `Last-Event-ID` of each; they come one after another, in this order.
    """
    limits = httpx.Limits(max_connections=None)
    base = str(app.http.base_url)
    async with httpx.AsyncClient(base_url=base, limits=limits, timeout=60, trust_env=False) as http:
        tasks: list[asyncio.Task[list[dict[str, Any]]]] = []
        for number, job_id in enumerate(job_ids):
            tasks.append(asyncio.create_task(_follow(http, job_id, after[number] if after else None)))
            if after:
                await asyncio.to_thread(wait_for, lambda: app.service.feed.followers == len(tasks), 30)
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

    streams = asyncio.run(followed(app, [jobs[n % 3] for n in range(FOLLOWERS)], act))
    expected = ["queued", "preparing", "log", "training", 1, 2, 3, "succeeded"]
    assert [brief(told) for told in streams] == [expected] * FOLLOWERS
    wait_for(lambda: app.service.feed.followers == 0)
    clients: Any = app.redis.client_list()
    assert len(clients) < 60
    wait_for(lambda: readers(app.redis) == 0)


def test_more_followers_than_the_process_takes_are_told_why(serve: Serve) -> None:
    app = serve(max_event_streams=2)
    job_id = app.job()

    def act() -> None:
        refused = problem(app.http.get(f"/v1/jobs/{job_id}/events"), 503, "too_many_followers")
        assert refused["facts"] == {"followers": 2, "limit": 2, "of_owner": 2, "limit_of_owner": 2}
        assert "SPLATMILL_MAX_EVENT_STREAMS" in refused["detail"]
        app.http.post(f"/v1/jobs/{job_id}/cancel")

    streams = asyncio.run(followed(app, [job_id] * 2, act))
    assert [brief(told) for told in streams] == [["queued", "cancelled"]] * 2
    wait_for(lambda: app.service.feed.followers == 0)
    assert brief(follow(app, job_id)) == ["queued", "cancelled"]


def test_followers_of_one_owner_leave_places_to_others(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    app = serve(max_event_streams=4)
    job_id = app.job()

    async def admin(asked: object, headers: Headers) -> Caller:
        return Caller(headers.get("x-owner", "default"))

    monkeypatch.setattr(app.service.authentication, "caller", admin)

    def act() -> None:
        refused = problem(app.http.get(f"/v1/jobs/{job_id}/events"), 503, "too_many_followers")
        assert (refused["facts"]["of_owner"], refused["facts"]["limit_of_owner"]) == (3, 3)
        with app.http.stream("GET", f"/v1/jobs/{job_id}/events", headers={"X-Owner": "bob"}) as answer:
            assert answer.status_code == 200
        app.http.post(f"/v1/jobs/{job_id}/cancel")

    streams = asyncio.run(followed(app, [job_id] * 3, act))
    assert [brief(told) for told in streams] == [["queued", "cancelled"]] * 3


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
        return [stored.event.done for stored, _ in batch.events if isinstance(stored.event, ProgressEvent)]

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


async def all_that_come(subscription: Subscription) -> None:
    while True:
        await subscription.next(1.0)


def test_followers_are_told_that_redis_does_not_answer(
    connection: redis.Redis, redis_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed, "_ANSWER_SECONDS", 1.0)
    job_id = "job00001"
    connection.hset(keys.job(job_id), "id", job_id)

    async def follow() -> None:
        client = connect_async(redis_url)
        reader = Feed(client)
        subscription = reader.subscribe(job_id)
        await reader.catch_up(subscription, [events.START] * len(events.BOUNDS))
        connection.client_pause(3000)
        with pytest.raises(redis.TimeoutError, match="has not answered for 1 seconds"):
            await all_that_come(subscription)
        reader.close(subscription)
        await reader.stop()
        await client.aclose()

    asyncio.run(follow())
    connection.client_unpause()


@pytest.mark.parametrize(
    "after", ["_".join([FAR, FAR, "1", FAR, FAR, FAR]), f"0-0_{FAR}_1{NONE}", f"0-0_0-0_999999999{NONE}"]
)
def test_a_position_beyond_the_end_concerns_nobody_else_and_misses_nothing(
    app: ServedApp, after: str
) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, ProgressEvent(stage="training", done=1), LogEvent(message="early"))

    def act() -> None:
        app.say(job_id, ProgressEvent(stage="training", done=2), LogEvent(message="late"))
        app.say(job_id, StateEvent(state=JobState.succeeded))

    streams = asyncio.run(followed(app, [job_id] * 3, act, [after, None, after]))
    expected = ["queued", "preparing", 1, "log", 2, "log", "succeeded"]
    assert [brief(told) for told in streams] == [expected] * 3


def test_followers_hear_of_a_redis_that_was_restored_with_an_older_clock(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed, "_CHECK_SECONDS", 0.1)
    job_id = app.job()
    app.begin(job_id)
    app.say(job_id, LogEvent(message="before"), ProgressEvent(stage="training", done=1))

    def restored() -> None:
        """The streams as an older copy has them, with entries whose ids are lower than those that were told."""
        wait_for(lambda: app.service.feed._followed[job_id].entries is not None)
        for stream in (keys.states, keys.log, keys.progress):
            entries: Any = app.redis.xrange(stream(job_id))
            app.redis.delete(stream(job_id))
            for number, (_, fields) in enumerate(entries):
                app.redis.xadd(stream(job_id), fields, id=f"{1000 + number}-0")

    # The streams of those who follow end, so that they come back.
    streams = asyncio.run(followed(app, [job_id], restored))
    assert [brief(told)[:2] for told in streams] == [["queued", "preparing"]]
    assert [len(told) for told in streams] == [4]

    def act() -> None:
        fields: Any = {"g": 1, "a": 1, "e": StateEvent(state=JobState.succeeded).model_dump_json()}
        app.redis.xadd(keys.states(job_id), fields, id="2000-0")

    streams = asyncio.run(followed(app, [job_id] * 2, act, [streams[0][-1]["id"], None]))
    assert [brief(told)[0] for told in streams] == ["queued"] * 2
    assert [brief(told)[-1] for told in streams] == ["succeeded"] * 2
    assert [len(told) for told in streams] == [5, 5]


def test_a_reader_that_cannot_go_on_ends_the_streams(app: ServedApp, monkeypatch: pytest.MonkeyPatch) -> None:
    job_id = app.job()
    app.begin(job_id)

    async def broken() -> None:
        raise ValueError("whatever is raised must not leave clients in silence")

    def act() -> None:
        monkeypatch.setattr(app.service.feed, "_pass_on", broken)
        app.say(job_id, LogEvent(message="after"))

    streams = asyncio.run(followed(app, [job_id] * 2, act))
    assert [brief(told)[:2] for told in streams] == [["queued", "preparing"]] * 2
    monkeypatch.undo()
    app.say(job_id, StateEvent(state=JobState.failed))
    assert brief(follow(app, job_id)) == ["queued", "preparing", "log", "failed"]
