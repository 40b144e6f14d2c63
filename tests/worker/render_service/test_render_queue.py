"""Proves that requests run one at a time, owners and clients in turn, and that those beyond the bounds are sent away;
and that nothing runs for a client that has left, which frees its place before its turn."""

import asyncio
import threading
from contextlib import AsyncExitStack
from functools import partial

import pytest

from splatmill_worker.render_service.render_queue import ClientGone, QueueFull, RenderQueue


def test_more_requests_than_may_wait_are_sent_away() -> None:
    async def crowd() -> tuple[int, int, int]:
        queue, release, inside, most = RenderQueue(max_waiting=2), threading.Event(), 0, 0

        def work() -> None:
            nonlocal inside, most
            inside += 1
            most = max(most, inside)
            release.wait(60)
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

        before = asyncio.create_task(queue.run(lambda: release.wait(60)))
        waiting = asyncio.create_task(queue.run(work, gone))
        await asyncio.sleep(0)
        release.set()
        await before
        with pytest.raises(ClientGone):
            await waiting
        return done

    assert asyncio.run(wait_in_vain()) is False


def test_clients_take_turns() -> None:
    async def mixed() -> list[str]:
        queue, release, order = RenderQueue(max_waiting=20), threading.Event(), list[str]()
        first = asyncio.create_task(queue.run(lambda: release.wait(60), client="ann"))
        await asyncio.sleep(0)
        waiting = [
            asyncio.create_task(queue.run(partial(order.append, name), client=name[:3]))
            for name in ("ann1", "ann2", "ann3", "bob1", "bob2", "eve1")
        ]
        await asyncio.sleep(0)
        release.set()
        await asyncio.gather(first, *waiting)
        return order

    assert asyncio.run(mixed()) == ["ann1", "bob1", "eve1", "ann2", "bob2", "ann3"]


def test_a_video_leaves_room_for_a_picture_after_each_frame() -> None:
    async def mixed() -> list[str]:
        queue, begun, order = RenderQueue(max_waiting=20), asyncio.Event(), list[str]()
        loop = asyncio.get_running_loop()

        def frame() -> None:
            order.append("frame")
            loop.call_soon_threadsafe(begun.set)

        async def video() -> None:
            for _ in range(50):
                await queue.run(frame, client="ann")

        async def pictures() -> None:
            await begun.wait()
            for _ in range(3):
                await queue.run(lambda: order.append("picture"), client="bob")

        await asyncio.gather(video(), pictures())
        return order

    order = asyncio.run(mixed())
    assert sorted(order) == ["frame"] * 50 + ["picture"] * 3
    assert order.index("picture") <= 3, (
        "the first picture waits for the frame that is rendered, not for the video"
    )


def test_one_client_cannot_take_all_places() -> None:
    async def crowd() -> tuple[int, bool]:
        queue, refused = RenderQueue(max_waiting=5, max_of_client=2), 0
        async with queue.admitted("ann"), queue.admitted("ann"):
            try:
                async with queue.admitted("ann"):
                    pass
            except QueueFull:
                refused += 1
            async with queue.admitted("bob"):
                pass
        async with queue.admitted("ann"):
            return refused, True

    assert asyncio.run(crowd()) == (1, True)


def test_owners_take_turns_and_so_do_the_clients_of_each() -> None:
    async def mixed() -> list[str]:
        queue, release, order = RenderQueue(max_waiting=20), threading.Event(), list[str]()
        first = asyncio.create_task(queue.run(lambda: release.wait(60), client="ann/0"))
        await asyncio.sleep(0)
        names = ("ann/1", "ann/1", "ann/2", "ann/3", "bob/1", "bob/1")
        waiting = [asyncio.create_task(queue.run(partial(order.append, name), client=name)) for name in names]
        await asyncio.sleep(0)
        release.set()
        await asyncio.gather(first, *waiting)
        return order

    assert asyncio.run(mixed()) == ["ann/1", "bob/1", "ann/2", "bob/1", "ann/3", "ann/1"]


def test_an_owner_with_many_clients_leaves_places_to_others() -> None:
    async def admitted(queue: RenderQueue, stack: AsyncExitStack, owner: str, count: int) -> int:
        """Number of requests that are admitted, of as many clients of an owner."""
        for number in range(count):
            try:
                await stack.enter_async_context(queue.admitted(f"{owner}/{number}"))
            except QueueFull:
                return number
        return count

    async def crowd() -> list[int]:
        queue = RenderQueue(max_waiting=9, max_of_client=3, max_of_owner=5, reserved=2)
        async with AsyncExitStack() as stack:
            counts = [
                await admitted(queue, stack, owner, 20) for owner in ("ann", "bob", "eve", "dan", "fay")
            ]
        assert queue.admitted_count == 0
        return counts

    # The last two places are for owners with no other request.
    assert asyncio.run(crowd()) == [5, 3, 1, 1, 0]


def test_a_client_that_leaves_while_it_waits_frees_its_place_at_once() -> None:
    """Not only when its turn comes: a picture before it may take long."""

    async def leave() -> tuple[bool, bool, list[str]]:
        queue, release, done = RenderQueue(max_waiting=2), threading.Event(), list[str]()

        async def gone() -> bool:
            return True

        before = asyncio.create_task(queue.run(lambda: release.wait(60)))
        await asyncio.sleep(0)

        async def visit(name: str, left: bool) -> None:
            async with queue.admitted(name):
                await queue.run(lambda: done.append(name), gone if left else None, name)

        leaving = asyncio.create_task(visit("ann", True))
        staying = asyncio.create_task(visit("bob", False))
        cancelled = asyncio.create_task(visit("eve", False))
        await asyncio.sleep(0)
        cancelled.cancel()
        with pytest.raises(ClientGone):
            await leaving
        still = not before.done()
        release.set()
        await asyncio.gather(before, staying, cancelled, return_exceptions=True)
        await queue.run(lambda: done.append("later"))
        return still, cancelled.cancelled(), done

    assert asyncio.run(leave()) == (True, True, ["bob", "later"])
