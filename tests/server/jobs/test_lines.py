"""The order in which workers take jobs: owners in turn, priority within one owner, and lines by what a job asks for.

Workers are played. Not proved here: that the project's worker takes entries in this way (tests/worker/service).
"""

import socket
from typing import Any

import pytest
import redis
from _capacity.operations import counted
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from splatmill.backplane import keys
from splatmill.backplane.connection import connect
from splatmill.backplane.queue import entries, leases, lines, queue, rq_keys, workers
from splatmill.backplane.queue.lines import LINES, Line
from splatmill.backplane.refusal import RedisRefuses
from splatmill.schema import Backend, TrainOptions
from splatmill_server.jobs import queue_places
from splatmill_server.jobs.queue_places import start_after
from tests.support.jobs import write_row
from tests.support.redis_server import RedisServer
from tests.support.served_app import ServedApp
from tests.support.servers.queue_entries import take, waiting


def submit(
    connection: redis.Redis, job_id: str, owner: str = "a", backend: str = "auto", priority: int = 0
) -> str:
    """Enqueue a job; return the id of its entry."""
    options = TrainOptions(backend=Backend(backend))
    write_row(connection, job_id, owner=owner, options=options, priority=priority)
    assert queue.enqueue(connection, job_id, 1)
    return entries.rq_id(job_id, 1)


def drain(connection: redis.Redis, *served: Line) -> list[str]:
    """The jobs that a worker takes, in order, until none is left for it."""
    taken = []
    while (turn := lines.take(connection, "tester", served or LINES)) is not None:
        taken.append(entries.split_rq_id(turn[0].entry)[0])
    return taken


def test_a_thousand_jobs_of_one_owner_delay_another_by_one_at_most(connection: redis.Redis) -> None:
    for number in range(1000):
        submit(connection, f"a{number}", "anna")
    take(connection)  # the one that runs
    submit(connection, "b0", "ben")
    submit(connection, "b1", "ben")
    assert drain(connection)[:4] == ["b0", "a1", "b1", "a2"]


def test_an_owner_who_was_served_long_ago_comes_first_and_not_twice(connection: redis.Redis) -> None:
    for owner in ("anna", "ben", "carl"):
        submit(connection, f"{owner}0", owner)
    assert drain(connection) == ["anna0", "ben0", "carl0"]
    for number in (1, 2):
        for owner in ("carl", "ben", "anna"):
            submit(connection, f"{owner}{number}", owner)
    assert drain(connection) == ["anna1", "ben1", "carl1", "anna2", "ben2", "carl2"]


def test_priority_orders_the_jobs_of_one_owner_and_overtakes_no_other(connection: redis.Redis) -> None:
    submit(connection, "b0", "ben", priority=-100)
    for job_id, priority in (("a0", 0), ("a1", 5), ("a2", 100), ("a3", 5), ("a4", -1)):
        submit(connection, job_id, "anna", priority=priority)
    assert drain(connection) == ["a2", "b0", "a1", "a3", "a0", "a4"]


@pytest.mark.parametrize("how", ["handed back", "worker lost", "process lost"])
def test_what_was_interrupted_goes_on_before_another_owner_begins(connection: redis.Redis, how: str) -> None:
    for job_id, owner in (("a0", "anna"), ("a1", "anna"), ("b0", "ben"), ("c0", "carl")):
        submit(connection, job_id, owner)
    lease, _ = lines.take(connection, "tester", LINES) or pytest.fail("nothing waits")
    if how == "handed back":
        assert lines.hand_back(connection, lease)
    elif how == "worker lost":
        assert leases.requeue(connection, lease, if_expired=False) == "waiting"
    else:
        leases.to_the_front(connection, lease.entry)
        connection.zrem(rq_keys.STARTED, lease.member)
        connection.hset(f"rq:job:{lease.entry}", "status", "queued")
        connection.rpush(entries.open_queue(connection).key, lease.entry)
    assert lines.look(connection, [lease.entry]).position(lease.entry, LINES) == 0
    assert drain(connection) == ["a0", "b0", "c0", "a1"]


def test_a_worker_takes_only_what_it_serves(connection: redis.Redis) -> None:
    submit(connection, "gpu", backend="gpu")
    submit(connection, "cpu", backend="cpu")
    submit(connection, "reference", backend="reference")
    submit(connection, "any")
    assert drain(connection, "any", "cpu") == ["cpu", "reference", "any"]
    assert waiting(connection) == 1
    assert drain(connection, "gpu", "any", "cpu") == ["gpu"]


def test_an_entry_without_a_row_or_with_options_of_another_version_runs_anywhere(
    connection: redis.Redis,
) -> None:
    for number, options in enumerate(["not json", "[1]", '{"backend": 3}', "{}"]):
        submit(connection, f"job{number}")
        lines.withdraw(connection, f"job{number}-1")
        connection.hset(keys.job(f"job{number}"), mapping={"options": options, "priority": "high"})
        connection.hset(f"rq:job:job{number}-1", "status", "queued")
        connection.rpush(entries.open_queue(connection).key, f"job{number}-1")
    connection.delete(keys.job("job3"))
    assert sorted(drain(connection, "any")) == ["job0", "job1", "job2", "job3"]


def test_an_entry_that_was_deleted_or_cancelled_is_passed_over(connection: redis.Redis) -> None:
    gone, cancelled, _ = (submit(connection, f"job{number}") for number in range(3))
    connection.delete(f"rq:job:{gone}")
    assert lines.withdraw(connection, cancelled)
    assert not lines.withdraw(connection, cancelled)
    assert queue.status(connection, "job1", 1).state == "stopped"
    assert drain(connection) == ["job2"]
    assert waiting(connection) == 0


def test_taking_leases_in_the_same_step(connection: redis.Redis) -> None:
    entry = submit(connection, "job00001")
    lease = take(connection, worker="mill-1")
    assert lease.entry == entry
    assert leases.held(connection) == [lease]
    status = queue.status(connection, "job00001", 1)
    assert (status.state, status.worker) == ("running", "mill-1")
    assert leases.running(connection).keys() == {"mill-1"}


def test_what_is_handed_back_or_lost_once_comes_first_and_what_is_lost_again_comes_last(
    connection: redis.Redis,
) -> None:
    for number in range(3):
        submit(connection, f"job{number}")
    assert lines.hand_back(connection, take(connection))
    lease = take(connection)
    assert lease.entry == "job0-1"
    assert leases.requeue(connection, lease, if_expired=False) == "waiting"
    assert not lines.hand_back(connection, lease), "it was lost, and is not the worker's any more"
    lease = take(connection)
    assert lease.entry == "job0-1", "a job that was interrupted continues before others begin"
    assert leases.requeue(connection, lease, if_expired=False) == "waiting"
    lease = take(connection)
    assert lease.entry == "job1-1", "a job that loses its worker again and again delays no other"
    leases.advanced(connection, lease.entry)
    assert leases.requeue(connection, lease, if_expired=False) == "waiting"
    leases.to_the_front(connection, "job2-1")
    assert drain(connection) == ["job1", "job2", "job0"], "job2 waited already"


arrivals = st.lists(
    st.tuples(st.sampled_from("abc"), st.integers(-2, 2), st.sampled_from(["auto", "cpu", "gpu"])),
    min_size=1,
    max_size=14,
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(earlier=arrivals, taken=st.integers(0, 8), later=arrivals, gpu=st.booleans())
def test_the_position_is_the_order_in_which_a_worker_takes_them(
    connection: redis.Redis, earlier: list[Any], taken: int, later: list[Any], gpu: bool
) -> None:
    connection.flushall()
    served: tuple[Line, ...] = ("any", "cpu", "gpu") if gpu else ("any", "cpu")
    numbers = iter(range(100))
    all_entries = []
    for batch in (earlier, later):
        for owner, priority, backend in batch:
            all_entries.append(submit(connection, f"job{next(numbers)}", owner, backend, priority))
        if batch is earlier:
            for _ in range(taken):
                lines.take(connection, "tester", served)
    order = lines.look(connection, all_entries)
    predicted = {
        entry: order.position(entry, served) for entry, place in order.places.items() if place.line in served
    }
    actual = [f"{job}-1" for job in drain(connection, *served)]
    assert predicted == {entry: number for number, entry in enumerate(actual)}


def test_when_a_job_starts() -> None:
    assert start_after(0, 100.0, [30.0]) == 30.0
    assert start_after(2, 100.0, [30.0]) == 230.0
    assert [start_after(position, 100.0, [70.0, 0.0]) for position in range(4)] == [0.0, 70.0, 100.0, 170.0]


def listen(connection: redis.Redis, name: str, *served: Line) -> None:
    """Register a worker, as RQ and the worker do."""
    connection.sadd("rq:workers", f"rq:worker:{name}")
    record: Any = {"state": "idle"} | workers.served(served)
    connection.hset(f"rq:worker:{name}", mapping=record)


def shown(app: ServedApp, job_id: str) -> tuple[Any, ...]:
    job = app.http.get(f"/v1/jobs/{job_id}").json()
    return job["queue_position"], job["waiting_for"], job["estimated_start"] is not None


def test_a_job_says_where_it_stands_and_what_it_waits_for(app: ServedApp) -> None:
    first, second = app.job(), app.job()
    on_gpu = app.job(backend="gpu")
    assert shown(app, first) == (0, "any", False)
    assert shown(app, on_gpu) == (0, "gpu", False)
    listen(app.redis, "plain", "any", "cpu")
    lines.record_duration(app.redis, "any", 60)
    assert shown(app, second) == (1, None, True)
    assert shown(app, on_gpu) == (0, "gpu", False)
    info = app.http.get("/v1/info").json()
    assert info["queues"] == {
        "any": {"waiting": 2, "workers": 1},
        "cpu": {"waiting": 0, "workers": 1},
        "gpu": {"waiting": 1, "workers": 0},
    }
    assert info["workers"][0]["queues"] == ["any", "cpu"]
    metrics = app.http.get("/metrics").text
    assert 'splatmill_queue_length{queue="gpu"} 1.0' in metrics
    assert 'splatmill_queue_workers{queue="any"} 1.0' in metrics
    listen(app.redis, "big", "any", "cpu", "gpu")
    # The worker with the GPU may take the two others before.
    assert shown(app, on_gpu) == (2, None, False)
    listed = {job["id"]: job["queue_position"] for job in app.http.get("/v1/jobs").json()["jobs"]}
    assert listed == {first: 0, second: 1, on_gpu: 2}
    take(app.redis, "any", worker="plain")
    assert shown(app, first) == (None, None, False)


@pytest.mark.parametrize("priority", [101, -101, "high", 1.5])
def test_a_priority_is_a_number_within_bounds(app: ServedApp, priority: object) -> None:
    answer = app.http.post("/v1/jobs", json={"capture": app.capture(), "priority": priority})
    assert answer.status_code == 422
    assert "priority" in answer.text


def test_a_priority_is_kept_and_shown(app: ServedApp) -> None:
    capture = app.capture()
    usual = app.job(capture)
    urgent = app.http.post("/v1/jobs", json={"capture": capture, "priority": 7}).json()
    assert (urgent["priority"], urgent["queue_position"]) == (7, 0)
    assert shown(app, usual)[0] == 1
    photos = [("images", (f"{name}.jpg", b"\xff\xd8\xff " + name.encode())) for name in "ab"]
    made = app.http.post("/v1/jobs", files=[*photos, ("priority", (None, "9"))]).json()
    assert (made["priority"], made["queue_position"]) == (9, 0)


def test_jobs_are_listed_while_redis_refuses_writes(app: ServedApp) -> None:
    job_id = app.job()
    app.redis.config_set("min-replicas-to-write", "1")
    try:
        assert shown(app, job_id)[0] == 0
        app.redis.config_set("min-replicas-to-write", "0")
        late = app.job()
        lines.withdraw(app.redis, f"{late}-1")
        app.redis.hset(f"rq:job:{late}-1", "status", "queued")
        app.redis.rpush(entries.open_queue(app.redis).key, f"{late}-1")
        app.redis.config_set("min-replicas-to-write", "1")
        # It cannot be sorted into its line now, so that its position is not known.
        assert shown(app, late) == (None, None, False)
        assert len(app.http.get("/v1/jobs").json()["jobs"]) == 2
    finally:
        app.redis.config_set("min-replicas-to-write", "0")
    assert shown(app, late)[0] == 1


def test_many_workers_are_not_read_for_each_job_that_waits(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(queue_places, "_FRESH_SECONDS_EACH", 60.0)
    jobs = app.service.jobs
    job_id = app.job()
    assert jobs.get(job_id).waiting_for == "any"
    listen(app.redis, "plain", "any", "cpu")
    assert jobs.get(job_id).waiting_for is None, "without workers, each look reads them"
    listen(app.redis, "another", "any")
    with counted() as operations:
        assert jobs.get(job_id).queue_position == 0
    assert operations.round_trips == 2, "the job, and its place in the queue"


def test_a_wait_ends_by_an_entry_or_a_socket_and_leaves_no_reply_behind(connection: redis.Redis) -> None:
    """A wait of 0 seconds has no end of its own."""
    wake, other_end = socket.socketpair()
    with wake, other_end:
        submit(connection, "a0")
        lines.sort(connection)
        lines.wait(connection, LINES, 0, wake)
        assert drain(connection) == ["a0"]
        other_end.send(b"x")
        for key in map(keys.bell, LINES):
            connection.delete(key)
        lines.wait(connection, LINES, 0, wake)
        assert connection.ping()
        connection.execute_command("ACL", "SETUSER", "default", "-blpop")
        wake.recv(1)
        with pytest.raises(RedisRefuses, match="NOPERM"):
            lines.wait(connection, LINES, 0, wake)


def test_a_wait_ends_where_redis_answers_no_more(redis_server: RedisServer) -> None:
    wake, other_end = socket.socketpair()
    connection = connect(redis_server.url, timeout=0.2)
    with wake, other_end, connection:
        connection.ping()
        with redis_server.paused(), pytest.raises(redis.TimeoutError, match="no answer to BLPOP"):
            lines.wait(connection, LINES, 1, wake)
        assert connection.ping()
