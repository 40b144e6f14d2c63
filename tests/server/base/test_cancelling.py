"""Tasks end, also those that have lost a cancellation."""

import asyncio
from contextlib import suppress
from typing import Any

import pytest
from anyio import create_task_group

from splatmill_server.base import cancelling


def test_a_task_that_lost_a_cancellation_is_cancelled_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cancelling, "_AGAIN_SECONDS", 0.05)
    lost = 0

    async def loop() -> None:
        nonlocal lost
        while True:
            try:
                await asyncio.sleep(60)
            except asyncio.CancelledError:
                lost += 1
                if lost == 3:
                    raise

    async def ended() -> tuple[bool, bool]:
        one, done = asyncio.create_task(loop()), asyncio.create_task(asyncio.sleep(0))
        await asyncio.sleep(0.01)
        async with asyncio.timeout(10):
            await cancelling.end(one, done)
        return one.cancelled(), done.done()

    assert asyncio.run(ended()) == (True, True)
    assert lost == 3


def test_who_is_cancelled_while_it_ends_a_task_waits_for_that_and_ends_then(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cancelling, "_AGAIN_SECONDS", 0.05)

    async def slow() -> None:
        for _ in range(2):
            with suppress(asyncio.CancelledError):
                await asyncio.sleep(60)

    async def ended() -> tuple[bool, bool]:
        inner = asyncio.create_task(slow())
        await asyncio.sleep(0)
        ending = asyncio.create_task(cancelling.end(inner))
        await asyncio.sleep(0)
        ending.cancel()
        await asyncio.wait({ending})
        return ending.cancelled(), inner.done()

    assert asyncio.run(ended()) == (True, True)


def test_a_task_ends_in_peace_where_the_client_of_a_response_has_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cancelled = waits = 0
    wait = asyncio.wait

    async def counted(*arguments: Any, **options: Any) -> Any:
        nonlocal waits
        waits += 1
        return await wait(*arguments, **options)

    monkeypatch.setattr(asyncio, "wait", counted)

    async def follow() -> None:
        nonlocal cancelled
        try:
            await asyncio.sleep(60)
        finally:
            for _ in range(20):  # what it does at its end takes some turns of the event loop
                try:
                    await asyncio.sleep(0.001)
                except asyncio.CancelledError:
                    cancelled += 1

    async def response() -> bool:
        task = asyncio.create_task(follow())
        await asyncio.sleep(0)
        async with create_task_group() as group:
            group.start_soon(cancelling.end, task)
            await asyncio.sleep(0.005)
            group.cancel_scope.cancel()
        return task.done()

    assert asyncio.run(response())
    assert (cancelled, waits) == (0, 1)


def test_what_a_task_raises_at_its_end_is_dropped(caplog: pytest.LogCaptureFixture) -> None:
    async def fails() -> None:
        try:
            await asyncio.sleep(60)
        finally:
            raise RuntimeError("while it ended")

    async def ended() -> bool:
        task = asyncio.create_task(fails())
        await asyncio.sleep(0)
        await cancelling.end(task)
        return task.done()

    assert asyncio.run(ended())
    assert "never retrieved" not in caplog.text
