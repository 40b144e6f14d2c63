"""Tiles in the queue: whoever takes or takes back a tile has it alone, and what a worker loses comes back.

Workers are played. That real ones train the tiles: tests/service/test_tiles.py.
"""

from __future__ import annotations

import pytest
import redis
from hypothesis import given
from hypothesis import strategies as st

from splatmill.backplane.queue import entries, leases, lines, queue, rq_keys
from splatmill.backplane.queue.lines import LINES
from splatmill.schema import Backend, TrainOptions
from tests.support.jobs import write_row

JOB = "job00001"


@pytest.fixture
def row(connection: redis.Redis) -> None:
    write_row(connection, JOB, owner="anna", options=TrainOptions(tiles=3, backend=Backend.cpu))


def take(connection: redis.Redis) -> leases.Lease:
    turn = lines.take(connection, "tester", LINES)
    assert turn is not None
    return turn[0]


@given(
    st.from_regex(r"[a-z0-9_-]{1,20}", fullmatch=True),
    st.integers(0, 10**6),
    st.integers(1, 1024),
)
def test_ids_of_tiles_and_of_jobs_are_told_apart(job_id: str, generation: int, tile: int) -> None:
    whole, part = entries.rq_id(job_id, generation), entries.unit_id(job_id, generation, tile)
    assert entries.split_rq_id(whole) == entries.split_rq_id(part) == (job_id, generation)
    assert (entries.tile_of(whole), entries.tile_of(part)) == (None, tile)


@pytest.mark.usefixtures("row")
def test_a_tile_waits_in_the_line_of_its_job_once(connection: redis.Redis) -> None:
    assert queue.offer_tile(connection, JOB, 1, 1)
    assert not queue.offer_tile(connection, JOB, 1, 1)
    place = lines.look(connection, [entries.unit_id(JOB, 1, 1)]).places[entries.unit_id(JOB, 1, 1)]
    assert (place.line, place.owner) == ("cpu", "anna")


@pytest.mark.usefixtures("row")
def test_a_tile_is_taken_or_taken_back_and_never_both(connection: redis.Redis) -> None:
    for tile in (1, 2):
        queue.offer_tile(connection, JOB, 1, tile)
    taken = take(connection)
    assert taken.entry == entries.unit_id(JOB, 1, 1)
    assert not queue.take_back_tile(connection, JOB, 1, 1)
    assert queue.take_back_tile(connection, JOB, 1, 2)
    assert lines.take(connection, "tester", LINES) is None
    assert queue.offer_tile(connection, JOB, 1, 2)  # by the next attempt
    assert take(connection).entry == entries.unit_id(JOB, 1, 2)


@pytest.mark.usefixtures("row")
@pytest.mark.parametrize("how", ["handed back", "lost"])
def test_a_tile_whose_worker_went_away_waits_again(connection: redis.Redis, how: str) -> None:
    queue.offer_tile(connection, JOB, 1, 3)
    lease = take(connection)
    if how == "handed back":
        assert lines.hand_back(connection, lease)
    else:
        assert leases.requeue(connection, lease, if_expired=False) == "waiting"
    assert take(connection).entry == entries.unit_id(JOB, 1, 3)


@pytest.mark.usefixtures("row")
def test_a_tile_that_redis_has_lost_or_lost_the_lease_of_can_be_taken_back(connection: redis.Redis) -> None:
    assert queue.take_back_tile(connection, JOB, 1, 1)
    queue.offer_tile(connection, JOB, 1, 2)
    lease = take(connection)
    assert not queue.take_back_tile(connection, JOB, 1, 2)
    connection.zrem(rq_keys.STARTED, lease.member)
    assert queue.take_back_tile(connection, JOB, 1, 2)


@pytest.mark.usefixtures("row")
def test_waiting_tiles_of_a_generation_are_withdrawn(connection: redis.Redis) -> None:
    for generation in (1, 2):
        for tile in (1, 2, 3):
            queue.offer_tile(connection, JOB, generation, tile)
    queue.withdraw_tiles(connection, JOB, 1, 3)
    queue.withdraw_tiles(connection, JOB, 2, None)
    waiting = [entries.unit_id(JOB, generation, tile) for generation in (1, 2) for tile in (1, 2, 3)]
    assert list(lines.look(connection, waiting).places) == waiting[3:]


def test_tiles_of_a_job_that_asks_for_a_gpu_are_for_every_worker(connection: redis.Redis) -> None:
    write_row(connection, JOB, options=TrainOptions(tiles=3, backend=Backend.gpu))
    queue.enqueue(connection, JOB, 1)
    queue.offer_tile(connection, JOB, 1, 1)
    tile, whole = entries.unit_id(JOB, 1, 1), entries.rq_id(JOB, 1)
    places = lines.look(connection, [tile, whole]).places
    assert (places[tile].line, places[whole].line) == ("any", "gpu")
