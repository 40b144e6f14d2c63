"""Proves that requests run one at a time, and that those beyond the bound are sent away at once; and that nothing runs
for a client that has left."""

import asyncio
import threading

import pytest

from splatmill_worker.render_service.render_queue import ClientGone, QueueFull, RenderQueue


def test_more_requests_than_may_wait_are_sent_away() -> None:
    async def crowd() -> tuple[int, int, int]:
        queue, release, inside, most = RenderQueue(max_waiting=2), threading.Event(), 0, 0

        def work() -> None:
            nonlocal inside, most
            inside += 1
            most = max(most, inside)
            release.wait(10)
            inside -= 1

        async def visit() -> bool:
            try:
                async with queue.admitted():
                    await queue.run(work)
            except QueueFull:
                return False
            return True

        visits = [asyncio.create_task(visit()) for _ in range(5)]
        done, _ = await asyncio.wait(visits, return_when=asyncio.FIRST_COMPLETED)
        release.set()
        served = await asyncio.gather(*visits)
        return len(done), sum(served), most

    assert asyncio.run(crowd()) == (2, 3, 1)


def test_work_of_a_client_that_left_while_it_waited_is_not_done() -> None:
    async def wait_in_vain() -> bool:
        queue, release, done = RenderQueue(max_waiting=2), threading.Event(), False

        def work() -> None:
            nonlocal done
            done = True

        async def gone() -> bool:
            return True

        before = asyncio.create_task(queue.run(lambda: release.wait(10)))
        waiting = asyncio.create_task(queue.run(work, gone))
        await asyncio.sleep(0)
        release.set()
        await before
        with pytest.raises(ClientGone):
            await waiting
        return done

    assert asyncio.run(wait_in_vain()) is False
