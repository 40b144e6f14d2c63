"""Proves that every check of a soak can fail: each fault that it looks for is planted, and is found by name.

Not proven here: that the service survives a soak (tests/service/test_soak.py, `make soak`).
"""

import hashlib
import json
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import httpx
import pytest
import redis
from _soak import agreement, attempts, faults, files, recovery, target, verdict
from _soak import service as soaked
from _soak.clients import Clients, Promise
from _soak.orphans import Adoption
from _soak.proxy import Proxy

from splatmill.backplane import keys, lists
from splatmill.backplane.jobs import events
from splatmill.backplane.queue import entries, queue, rq_keys
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.process import start_time
from splatmill.schema import JobState, Problem, StateEvent
from tests.support.served_app import Serve, ServedApp
from tests.support.waiting import wait_for

OTHER = "f" * 16


def line(what: str, job: str = "a", at: float = 0.0, **more: Any) -> dict[str, Any]:
    begun = {"overlap": False, "published": False} if what == "begin" else {}
    return {"what": what, "job": job, "at": at, "pid": 7, **begun, **more}


def step(number: int, at: float = 0.0, job: str = "a") -> dict[str, Any]:
    return line("step", job, at, stage="training", step=number)


def stored(number: int) -> dict[str, Any]:
    return line("stored", step=number)


def resumed(number: int) -> dict[str, Any]:
    return line("resume", step=number)


# What ran


def test_a_job_that_only_begins_again_has_not_got_on() -> None:
    records = [
        line("begin", at=1),
        step(1, 2),
        line("begin", "b", 3),
        line("begin", at=6),
        line("begin", at=8),
    ]
    assert attempts.interrupted(records, 5, ended=()) == {"a", "b"}
    assert attempts.interrupted(records, 5, ended=["b"]) == {"a"}
    assert attempts.interrupted(records, 2, ended=()) == {"a"}
    assert attempts.got_on(records, 5) == {}
    assert attempts.got_on([*records, step(2, 9), step(3, 10)], 5) == {"a": 9}
    assert attempts.got_on([*records, line("end", at=9)], 5) == {"a": 9}


def test_a_job_waits_for_as_long_as_the_worker_trains_others() -> None:
    others = [
        line("begin", "b", 3) | {"pid": 8},
        step(1, 9, "b") | {"pid": 8},
        line("end", "b", 11) | {"pid": 8},
        line("begin", "c", 12) | {"pid": 9},
        step(1, 15, "c") | {"pid": 9},  # and then it was killed
    ]
    own = [line("begin", at=1), step(1, 2), line("begin", at=20), step(2, 28)]
    assert attempts.busy_with_others([*own, *others], 5, {"a"}) == (11 - 9) + (15 - 12)
    assert attempts.busy_with_others(own, 0, {"a"}) == 0


def test_attempts_beside_each_other_are_found() -> None:
    assert attempts.overlapping([line("begin"), step(1)]) == []
    assert attempts.overlapping([line("begin", overlap=True)]) == [
        "two attempts at a ran at once, one of them process 7"
    ]


def test_steps_that_are_taken_again_are_found() -> None:
    whole = [line("begin"), resumed(0), stored(10), stored(20), line("begin"), resumed(20), stored(30)]
    assert attempts.repeated(whole) == []
    assert attempts.resumptions(whole) == 1
    assert attempts.repeated([*whole, stored(30)]) == []  # a worker that is stopped stores its step once more
    assert attempts.repeated([*whole, line("begin"), resumed(20)]) == [
        "a was resumed from step 20 though step 30 was stored"
    ]
    assert attempts.repeated([*whole, stored(25)]) == ["a stored step 25 after step 30"]
    tile = [line("unit", unit="tile-1"), line("unit stored", unit="tile-1")]
    assert attempts.repeated([tile[0], *tile, line("unit", unit="tile-2")]) == []
    assert attempts.repeated([*tile, tile[0]]) == ["process 7 did tile-1 of a again, which was stored"]


def test_cameras_that_are_recovered_again_are_found() -> None:
    posed = [line("step", stage="mapping", step=None), line("step", stage="training", step=None)]
    again = line("step", stage="mapping", step=None)
    assert attempts.repeated([*posed, *posed]) == []
    assert attempts.repeated([*posed, again | {"pid": 8, "job": "b"}]) == []
    assert attempts.repeated([*posed, again | {"pid": 8}, again | {"pid": 8}]) == [
        "process 8 recovered the cameras of a again, which were stored"
    ]


def test_a_pipeline_that_runs_for_a_stored_model_is_found() -> None:
    assert attempts.run_again([line("begin"), line("end"), line("begin")]) == []
    assert attempts.run_again([line("begin", published=True)]) == [
        "process 7 ran a again, whose model was stored"
    ]


# What is left


def test_a_process_that_outlives_its_parent_is_found() -> None:
    adoption = Adoption()
    if adoption.missing is not None:
        pytest.skip(adoption.missing)
    child = "import os, time; print(os.getpid(), flush=True); os.environ.clear(); time.sleep(600)"
    program = f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', {child!r}])"
    try:
        with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as parent:
            assert parent.stdout is not None
            orphan = int(parent.stdout.readline())
            parent.wait(20)
            wait_for(lambda: adoption.orphans([parent.pid]) == [orphan])
            os.kill(orphan, signal.SIGKILL)
            wait_for(lambda: adoption.orphans([parent.pid]) == [])
            assert start_time(orphan) is None
    finally:
        adoption.end()


# What is stored


@dataclass
class Ended:
    """A service with a job that has succeeded and one that was cancelled, and nothing under way."""

    app: ServedApp
    capture: str
    job: str
    cancelled: str

    @property
    def storage(self) -> Storage:
        return self.app.service.storage

    @property
    def redis(self) -> redis.Redis:
        return self.app.redis

    def listed(self) -> dict[str, list[str]]:
        ids = {}
        for kind in ("captures", "jobs", "models"):
            ids[kind] = [one["id"] for one in self.app.http.get(f"/v1/{kind}").json()[kind]]
        return ids

    def differences(self) -> list[str]:
        return agreement.compare(self.redis, self.storage, self.listed(), [self.capture])

    def change(self, path: str, **changes: Any) -> None:
        record = json.loads(self.storage.get(path))
        self.storage.put(path, json.dumps(record | changes).encode())


@pytest.fixture
def ended(serve: Serve) -> Ended:
    app = serve()
    capture = app.capture()
    job, cancelled = app.job(capture), app.job(capture)
    app.begin(job)
    app.finish(job)
    app.http.post(f"/v1/jobs/{cancelled}/cancel")
    service = Ended(app, capture, job, cancelled)
    service.change(layout.job_record(job), capture=capture, generation=1)
    app.service.reaper.tick()
    queue.withdraw(app.redis, job, 1)  # no worker has taken the entry of the one that has succeeded
    return service


@pytest.fixture
def clients(ended: Ended) -> Iterator[Clients]:
    """Clients of it that look when they are told to."""
    users = Clients(cast(Any, ended.app), seed=0)
    yield users
    users._http.close()


def test_a_service_at_rest_agrees(ended: Ended) -> None:
    assert ended.differences() == []
    assert agreement.remains(ended.redis, ended.storage) == {}
    assert files.strays(ended.storage) == []


PLANTED: dict[str, tuple[Callable[[Ended], Any], str]] = {
    "a capture is lost": (
        lambda e: e.storage.delete(layout.capture_record(e.capture)),
        "accepted and is lost",
    ),
    "a capture is not indexed": (
        lambda e: e.redis.zrem(lists.name("captures"), e.capture),
        "in storage and not in Redis",
    ),
    "a log is lost": (lambda e: e.storage.delete(layout.job_log(e.job)), "in Redis and not in storage"),
    "a model is lost": (lambda e: e.storage.delete(layout.job_record(e.job)), "storage has no model"),
    "a model is not indexed": (
        lambda e: e.redis.zrem(lists.name("models"), e.job),
        "in storage and not in Redis",
    ),
    "a model is of another generation": (
        lambda e: e.change(layout.job_record(e.job), generation=2),
        "generation of",
    ),
    "a model is of another capture": (
        lambda e: e.change(layout.job_record(e.job), capture=OTHER),
        "capture of",
    ),
    "a model of a cancelled job": (
        lambda e: e.storage.put(layout.job_record(e.cancelled), e.storage.get(layout.job_record(e.job))),
        "is cancelled, and storage has a model of it",
    ),
    "a row is lost": (lambda e: e.redis.delete(keys.job(e.job)), "Redis has no row of it"),
    "a job is in two groups": (
        lambda e: e.redis.zadd(lists.name("jobs", group="failed"), {e.job: 1}),
        "is succeeded and in the lists of ['failed', 'succeeded']",
    ),
    "a job counts as unfinished": (
        lambda e: e.redis.zadd(lists.name("jobs", group=lists.UNFINISHED), {e.job: 1}),
        "in the lists of ['succeeded', 'unfinished']",
    ),
    "Redis holds a stray": (lambda e: e.redis.set(keys.attempts(OTHER), 1), "storage has no such job"),
    "Redis has another end": (
        lambda e: e.redis.delete(keys.states(e.job)),
        "state of",
    ),
}


@pytest.mark.parametrize("planted", PLANTED)
def test_a_difference_between_redis_and_storage_is_found(ended: Ended, planted: str) -> None:
    plant, named = PLANTED[planted]
    plant(ended)
    differences = ended.differences()
    assert any(named in sentence for sentence in differences), differences


def test_a_list_that_tells_twice_or_not_at_all_is_found(ended: Ended) -> None:
    listed = ended.listed()
    doubled = listed | {"jobs": [*listed["jobs"], ended.job]}
    assert agreement.compare(ended.redis, ended.storage, doubled, []) == [f"{ended.job} is listed 2 times"]
    short = listed | {"jobs": [ended.cancelled]}
    assert agreement.compare(ended.redis, ended.storage, short, []) == [
        f"jobs: {ended.job} is in storage and not in the API's list"
    ]


LEFT: dict[str, Callable[[Ended], Any]] = {
    "unfinished jobs": lambda e: e.redis.sadd(keys.ACTIVE, e.job),
    "leases": lambda e: e.redis.zadd(rq_keys.STARTED, {f"{entries.rq_id(e.job, 1)}:x": 9e9}),
    "waiting entries": lambda e: e.app.job(e.capture),
    "locks": lambda e: e.redis.hset(keys.lock(e.job), "token", "x"),
    "marks of work in storage": lambda e: e.storage.put(layout.unfinished_job(e.job), b"{}"),
    "checkpoints in storage": lambda e: e.storage.put(f"{layout.job_work(e.job)}/plan.json", b"{}"),
}


@pytest.mark.parametrize("what", LEFT)
def test_work_that_is_left_is_found(ended: Ended, what: str) -> None:
    LEFT[what](ended)
    assert what in agreement.remains(ended.redis, ended.storage)


def test_the_units_of_a_cancelled_job_are_kept_for_a_restart(ended: Ended) -> None:
    """Those of one that has succeeded are not."""
    for job in (ended.cancelled, ended.job):
        ended.storage.put(f"{layout.job_units(job)}/plan.json", b"{}")
    left = f"{layout.job_units(ended.job)}/plan.json"
    assert agreement.remains(ended.redis, ended.storage, [ended.cancelled]) == {
        "checkpoints in storage": [left]
    }
    (sentence,) = files.strays(ended.storage, [ended.cancelled])
    assert sentence.startswith(left)


def test_an_end_that_is_told_twice_is_found(ended: Ended) -> None:
    assert verdict.told_twice(ended.redis, {ended.job, ended.cancelled}) == []
    events.append(ended.redis, ended.job, 1, 2, StateEvent(state=JobState.succeeded))
    assert verdict.told_twice(ended.redis, {ended.job}) == [f"{ended.job} was told to have succeeded 2 times"]


SPOILED: dict[str, tuple[Callable[[Ended], Any], str]] = {
    "a photo breaks off": (
        lambda e: e.storage.put(layout.capture_file(e.capture, cast(Any, "images"), "a.jpg"), b"\xff"),
        "is not the digest of",
    ),
    "a photo is missing": (
        lambda e: e.storage.delete(layout.capture_file(e.capture, cast(Any, "images"), "a.jpg")),
        "digest of a file that is missing",
    ),
    "an upload is left": (
        lambda e: e.storage.put(layout.capture_incoming(e.capture, "1"), b"half"),
        "nothing is being uploaded",
    ),
    "a record breaks off": (
        lambda e: e.storage.put(layout.job_record(e.job), b'{"id":'),
        "is no JSON",
    ),
    "a log breaks off": (
        lambda e: e.storage.put(layout.job_log(e.job), e.storage.get(layout.job_log(e.job))[:-1]),
        "breaks off in a line",
    ),
    "a model has no record": (
        lambda e: e.storage.delete(layout.job_record(e.job)),
        "a file of a model without a record",
    ),
    "a preview has no job": (
        lambda e: e.storage.put(layout.model_file(OTHER, "preview.jpg"), b"x"),
        "a file of a model without a record",
    ),
    "a file is not listed": (
        lambda e: (cast(Any, e.storage.root) / "models" / ".model.ply.1234.part").write_bytes(b"half"),
        "",
    ),
}


@pytest.mark.parametrize("spoiled", SPOILED)
def test_a_file_that_is_not_whole_or_not_explained_is_found(ended: Ended, spoiled: str) -> None:
    plant, named = SPOILED[spoiled]
    plant(ended)
    strays = files.strays(ended.storage)
    assert strays
    assert any(named in sentence for sentence in strays), strays


def test_the_preview_of_a_job_that_has_no_model_is_explained(ended: Ended) -> None:
    ended.storage.put(layout.model_file(ended.cancelled, "preview.jpg"), b"x")
    assert files.strays(ended.storage) == []


def test_a_file_that_differs_from_what_was_uploaded_or_recorded_is_found(ended: Ended) -> None:
    photo = layout.capture_file(ended.capture, cast(Any, "images"), "a.jpg")
    promise = Promise(
        ended.job,
        ended.capture,
        {"images/a.jpg": ended.storage.get(photo)},
        photos=3,
        state=JobState.succeeded.value,
    )
    cameras: dict[str, Any] = {"cameras": [{}, {}, {}]}
    ended.storage.put(layout.model_file(ended.job, "cameras.json"), json.dumps(cameras).encode())
    ply = layout.model_file(ended.job, "model.ply")
    ended.change(layout.job_record(ended.job), sha256={"model.ply": _sha256(ended.storage.get(ply))})
    assert files.halves([promise], ended.storage) == []
    promise.photos = 4
    assert files.halves([promise], ended.storage) == [f"{ended.job} was made of 3 photos, not of 4"]
    promise.photos = 3
    ended.storage.put(ply, ended.storage.get(ply)[:-1])
    assert files.halves([promise], ended.storage) == [f"{ply} is not whole"]
    ended.storage.put(photo, b"other")
    ended.storage.delete(ply)
    assert files.halves([promise], ended.storage) == [
        f"{photo} is not what was uploaded",
        f"{ply} is not whole",
    ]


# What must work again after a fault


def served(broken: str) -> tuple[Any, Any]:
    """A service and its clients as `recovery` asks them, of which one thing does not work."""

    def answer(request: httpx.Request) -> httpx.Response:
        if request.url.path.endswith("/render"):
            return httpx.Response(503) if broken == "shows" else httpx.Response(200, content=b"\x89PNG")
        return httpx.Response(503 if broken == "accepts" else 201, json={"id": OTHER})

    records = [line("begin", at=1.0), *([] if broken == "resumes" else [step(1, time.monotonic())])]
    service = SimpleNamespace(
        ready=lambda: broken != "answers",
        patience=1.0,
        http=httpx.Client(transport=httpx.MockTransport(answer), base_url="http://service"),
        records=lambda: records,
        orphans=lambda: [os.getpid()] if broken == "orphans" else [],
    )
    promises = {"b": Promise("b", OTHER, {}, state="succeeded"), "a": Promise("a", OTHER, {})}
    unfinished = [promises["a"]]
    return service, SimpleNamespace(promises=promises, captures=[], unfinished=lambda: unfinished)


@pytest.mark.parametrize("broken", recovery.MEASURED)
def test_what_does_not_work_again_is_named(broken: str) -> None:
    service, clients = served(broken)
    healed = time.monotonic() - recovery.RESUME_SECONDS + 0.5
    measured, complaint = recovery.recover(service, clients, healed, healed)
    assert set(measured) == set(recovery.MEASURED) - {broken}
    assert complaint is not None
    assert broken in complaint
    assert ("['a']" in complaint) is (broken == "resumes")


def test_what_works_again_is_measured_and_a_capture_that_was_made_must_be_kept() -> None:
    service, clients = served("")
    measured, complaint = recovery.recover(service, clients, 2.0, time.monotonic() - 5)
    assert complaint is None
    assert set(measured) == set(recovery.MEASURED)
    assert all(4 < seconds < 30 for seconds in measured.values())
    assert clients.captures == [OTHER]


def test_a_job_that_failed_and_was_restarted_waits_as_a_new_one() -> None:
    service, clients = served("resumes")
    healed = time.monotonic()
    assert recovery.missing(service, clients, healed, healed) == {"a"}
    clients.promises["a"].restarted_at = 2.0
    assert recovery.missing(service, clients, healed, healed) == set()
    service.records().append(line("begin", at=3.0))
    assert recovery.missing(service, clients, healed, healed) == {"a"}


def test_an_orphan_after_a_fault_is_named() -> None:
    service, clients = served("orphans")
    _, complaint = recovery.recover(service, clients, 2.0, time.monotonic() - recovery.RESUME_SECONDS + 0.5)
    assert complaint is not None
    assert complaint.startswith("These processes have lost their parent")


# What clients meet


@pytest.mark.parametrize(
    ("code", "faults", "failed"),
    [
        ("storage_full", ["disk full"], False),
        ("storage_full", ["Redis killed"], True),
        ("queue_unavailable", ["Redis stalled"], False),
        ("attempts_exhausted", ["worker killed"], True),
        ("internal_error", ["disk full"], True),
    ],
)
def test_a_job_that_fails_without_a_fault_that_explains_it_is_lost(
    ended: Ended, clients: Clients, code: str, faults: list[str], failed: bool
) -> None:
    app = ended.app
    clients.faults = [(name, time.monotonic()) for name in faults]
    job = app.job(ended.capture)
    app.begin(job)
    app.say(job, StateEvent(state=JobState.failed, problem=Problem.of(code, "It failed.", advice="Look.")))
    promise = Promise(job, ended.capture, {})
    clients._look(promise)
    assert (promise.failure is not None) is failed
    assert (promise.restarts == 1) is not failed


def test_a_job_that_is_cancelled_unasked_or_forgotten_is_lost(ended: Ended, clients: Clients) -> None:
    cancelled, forgotten = Promise(ended.cancelled, ended.capture, {}), Promise(OTHER, ended.capture, {})
    forgotten.missing_since = time.monotonic() - 60
    for promise in (cancelled, forgotten):
        clients._look(promise)
        assert promise.failure is not None
        clients.promises[promise.job] = promise
    sentences = verdict.lost(clients, [ended.job], [ended.job, OTHER])
    assert [f"{ended.cancelled} failed", f"{OTHER} failed"] == [one.partition(":")[0] for one in sentences]


def test_a_job_or_model_that_is_not_listed_is_lost(ended: Ended, clients: Clients) -> None:
    promise = clients.promises[ended.job] = Promise(ended.job, ended.capture, {}, state="succeeded")
    assert verdict.lost(clients, [ended.job], [ended.job]) == []
    assert len(verdict.lost(clients, [], [])) == 2
    promise.state = "cancelled"
    assert verdict.lost(clients, [ended.job], [ended.job]) == [
        f"{ended.job} is cancelled and is among the models"
    ]


def test_a_job_that_does_not_end_is_told(
    ended: Ended, clients: Clients, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verdict, "SETTLE_SECONDS", 0.1)
    clients.service = cast(Any, SimpleNamespace(patience=1.0))
    assert verdict.settle(clients) == []
    clients.promises["a"] = Promise("a", ended.capture, {}, state="training")
    assert verdict.settle(clients) == ["a is still training 0.1 s after the last fault"]


# Faults that happen


def test_a_whole_soak_has_its_kills_and_every_kind_of_fault() -> None:
    chosen = faults.schedule(list(faults.FAULTS), faults.enough(faults.FAULTS), random.Random(0))
    assert sum(fault.kills for fault in chosen) >= faults.KILLS
    assert all(chosen.count(fault) >= 5 for fault in faults.FAULTS)


def test_the_kill_of_any_role_can_be_asked_for_and_of_nothing_else() -> None:
    chosen = faults.schedule(list(faults.FAULTS), 0, random.Random(0), ["decoder of the trainer killed"])
    assert [fault.name for fault in chosen] == ["decoder of the trainer killed"]
    with pytest.raises(ValueError, match="no faults"):
        faults.schedule(list(faults.FAULTS), 0, random.Random(0), ["decoder"])


def test_a_fault_that_meets_nothing_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(target, "_MET_SECONDS", 0.1)
    monkeypatch.setattr(target, "HOLD", (0.0, 0.0))
    service = cast(Any, SimpleNamespace(wait_for=soaked.wait_for))
    reached, ended = target.Target(service, random.Random(0)), threading.Event()

    def ask() -> None:
        while not ended.wait(0.01):
            with suppress(OSError), socket.create_connection(("127.0.0.1", proxy.port), 0.1) as client:
                client.sendall(b"x")
                client.recv(1)

    with socket.create_server(("127.0.0.1", 0)) as server:
        proxy = Proxy(server.getsockname())
        try:
            for what in ("cut", "stall", "fail"):
                with pytest.raises(AssertionError, match="the fault has met a request"):
                    faults.spoil(reached, proxy, what)
            monkeypatch.setattr(target, "_MET_SECONDS", 20.0)
            asking = threading.Thread(target=ask, daemon=True)
            asking.start()
            for what in ("cut", "stall", "fail"):
                faults.spoil(reached, proxy, what)
                assert proxy.met
        finally:
            ended.set()
            proxy.close()


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
