"""kill -9 of anything: the trainer, the worker, the API, Redis, the whole service. Each job still ends succeeded,
continues from its checkpoint, and never runs twice at once.

Does not cover the loss of a machine among several: there the heartbeat decides, which tests/server covers.
"""

import os
import signal

import httpx
import pytest

from splatmill.backplane.queue import entries, leases
from splatmill.backplane.storage import layout
from tests.support.up import Up
from tests.support.waiting import gone, wait_for

pytestmark = pytest.mark.slow

STEPS = 40


def check_resumed(up: Up, job_id: str, attempts: int = 2) -> None:
    job = up.ended(job_id)
    assert job["state"] == "succeeded", job
    assert job["attempt"] == attempts
    diary = up.diary(job_id)
    assert len(diary) == attempts
    assert diary[-1]["from"] >= 5, "the last attempt began anew instead of from its checkpoint"
    assert not any(entry["overlap"] for entry in diary), "two attempts ran at once"


def test_a_killed_trainer_is_followed_at_once(service: Up) -> None:
    job_id = service.submit(steps=STEPS)
    service.reached(job_id, 6)
    os.kill(service.trainer(job_id), signal.SIGKILL)
    check_resumed(service, job_id)
    lines = service.http.get(f"/v1/jobs/{job_id}/logs").json()["lines"]
    assert any("SIGKILL" in line["message"] for line in lines)


def test_a_killed_worker_takes_its_trainer_along_and_is_followed(service: Up) -> None:
    job_id = service.submit(steps=STEPS)
    service.reached(job_id, 6)
    worker, trainer = service.worker, service.trainer(job_id)
    os.kill(worker, signal.SIGKILL)
    wait_for(lambda: gone([worker, trainer]))
    check_resumed(service, job_id)


def test_a_worker_killed_again_and_again_does_not_use_up_the_tries_of_a_job_that_gets_on(service: Up) -> None:
    enough = service.data.parent / "enough"
    job_id = service.submit(steps=10_000, pause=0.05, until=str(enough))

    def nothing_lost() -> bool:
        with service.redis() as connection:
            return leases.lost(connection, entries.rq_id(job_id, 1)) == 0

    for _ in range(leases.MAX_LOST + 1):
        service.reached(job_id, service.job(job_id)["progress"]["step"] + 5 if service.diary(job_id) else 5)
        wait_for(nothing_lost)  # a heartbeat has seen a new checkpoint
        os.kill(service.worker, signal.SIGKILL)
    enough.touch()
    job = service.ended(job_id)
    assert job["state"] == "succeeded", job
    assert not any(entry["overlap"] for entry in service.diary(job_id))


def test_a_job_that_ends_its_worker_each_time_is_given_up(service: Up) -> None:
    job_id = service.submit(steps=10, do="kill worker", at=1)
    other = service.submit(steps=1)
    job = service.ended(job_id, 180)
    assert job["problem"]["code"] == "attempts_exhausted"
    assert job["problem"]["facts"]["lost_workers"] == len(service.diary(job_id)) == leases.MAX_LOST
    # It went behind the job that waited, whose first attempt it would have delayed for ever.
    assert service.ended(other)["finished_at"] < job["finished_at"]


@pytest.mark.parametrize("children", [True, False], ids=["with its children", "alone"])
def test_a_killed_service_leaves_nothing_and_goes_on_when_started_again(service: Up, children: bool) -> None:
    done = service.submit(steps=1)
    service.ended(done)
    job_id = service.submit(steps=STEPS)
    waiting = service.submit(steps=2)
    service.reached(job_id, 6)
    family = service.kill(children=children)
    wait_for(lambda: gone(family))

    service.start()
    check_resumed(service, job_id)
    job = service.ended(waiting)
    assert job["state"] == "succeeded", job
    assert service.job(done)["state"] == "succeeded"
    assert service.http.get(f"/v1/models/{done}").status_code == 200


def test_a_redis_that_comes_back_empty_loses_no_job_and_no_attempt(own_service: Up) -> None:
    own_service.start()
    done = own_service.submit(steps=1)
    own_service.ended(done)
    running = own_service.submit(steps=150, pause=0.05)  # more than a heartbeat beyond the loss
    waiting = own_service.submit(steps=1)
    own_service.reached(running, 6)

    def noted() -> bool:
        return own_service.data.joinpath("storage", layout.job_log(done)).is_file()

    wait_for(noted)
    with own_service.redis() as connection:
        connection.flushall()
    listed = own_service.http.get("/v1/jobs").json()["jobs"]
    assert {job["id"] for job in listed} == {done, running, waiting}
    assert own_service.job(done)["state"] == "succeeded"
    job = own_service.ended(running)
    assert (job["state"], job["attempt"], len(own_service.diary(running))) == ("succeeded", 1, 1)
    job = own_service.ended(waiting)
    assert job["state"] == "succeeded", job
    models = own_service.http.get("/v1/models").json()["models"]
    assert {model["id"] for model in models} == {done, running, waiting}


def test_a_stopped_service_saves_its_job_and_spends_no_try(service: Up) -> None:
    job_id = service.submit(steps=STEPS)
    service.reached(job_id, 6)
    family = [child.pid for child in service.tree()]
    assert service.stop() == 0
    assert gone(family)

    service.start()
    check_resumed(service, job_id)
    lines = service.http.get(f"/v1/jobs/{job_id}/logs").json()["lines"]
    assert any(line["message"].startswith("saved at step") for line in lines)
    with service.redis() as connection:
        entry = entries.open_queue(connection).fetch_job(entries.rq_id(job_id, 1))
    assert entry is not None
    assert entry.retries_left == entries.MAX_RETRIES


def test_a_killed_redis_comes_back_and_the_trainer_never_notices(service: Up) -> None:
    job_id = service.submit(steps=STEPS)
    service.reached(job_id, 6)
    trainer = service.trainer(job_id)
    os.kill(service.child("redis"), signal.SIGKILL)
    wait_for(lambda: service.http.get("/readyz").status_code == 200)
    job = service.ended(job_id)
    assert job["state"] == "succeeded"
    assert job["attempt"] == 1
    assert [entry["pid"] for entry in service.diary(job_id)] == [trainer]


def test_a_killed_api_and_renderer_answer_again(service: Up) -> None:
    api = service.child("splatmill_server.up.api")
    os.kill(api, signal.SIGKILL)
    wait_for(lambda: gone([api]))
    # The port stays open, so that a new connection waits for the next API instead of being refused.
    assert httpx.get(service.http.base_url.join("/healthz"), timeout=30).status_code == 200
    os.kill(service.child("renderer"), signal.SIGKILL)
    wait_for(lambda: service.http.get("/readyz").json()["checks"]["renderer"] == "ok")
