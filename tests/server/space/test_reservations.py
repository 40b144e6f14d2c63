"""Proves that many requests at once never store more than a quota: edits, conversions, also through a link, orbit
videos, uploads, captures and jobs, on a real server, renderer and Redis; and that each reservation ends.

Not proved here: what a worker stores (tests/worker/service/test_room.py).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest
import redis

from splatmill.backplane import keys, reservations
from splatmill.backplane.reservations import NoRoom
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Entry
from splatmill.schema import DOWNLOADS, CameraSpec, StoredKind
from splatmill_server.space.quota import JOB_ROOM
from tests.server.space.conftest import Clock, Person, ServePeople
from tests.support.served_app import ServedApp, problem
from tests.support.servers.rendering import hold_out, serve_in, store_only_ball
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow

MODEL = "b" * 16
WISH = {"seconds": 1, "fps": 10, "width": 96, "height": 64}


@pytest.fixture
def app(serve_people: ServePeople, folder: Path, renderer: object) -> ServedApp:
    """A server whose owner `default` has one model of 400 Gaussians."""
    running = serve_in(serve_people, folder)
    store_only_ball(running, folder, MODEL, "ball")
    view = CameraSpec.looking_at((4, 0, 0), (0, 0, 0), width=96, height=64)
    hold_out(running, MODEL, [view])
    return running


def in_storage(app: ServedApp) -> int:
    return sum(
        entry.size for kind in ("captures", "jobs", "models") for entry in app.service.storage.walk(kind)
    )


def at_once(count: int, ask: Callable[[int], httpx.Response]) -> list[httpx.Response]:
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(ask, range(count)))


def check_refused(app: ServedApp, answers: list[httpx.Response], good: int, limit: int) -> int:
    """Check that some were admitted, others refused by the quota, and that it holds. Return how many were admitted."""
    admitted = [answer for answer in answers if answer.status_code == good]
    for answer in answers:
        if answer.status_code != good:
            problem(answer, 507, "quota_exceeded")
    assert 0 < len(admitted) < len(answers)
    assert in_storage(app) <= limit
    assert app.service.usage.ledger.bytes_of("default") <= limit
    return len(admitted)


def test_of_many_edits_at_once_those_that_fit_are_stored(app: ServedApp) -> None:
    size = in_storage(app)
    limit = 4 * size
    ann = Person(app.http, "default", limit)
    body = {"min_opacity": 1e-6}
    answers = at_once(14, lambda _: ann("POST", f"/v1/models/{MODEL}/edits", json=body))
    check_refused(app, answers, 201, limit)
    app.service.usage.scan()
    assert app.service.usage.ledger.bytes_of("default") == in_storage(app) <= limit


def test_of_many_conversions_at_once_those_that_fit_are_stored_also_through_a_link(app: ServedApp) -> None:
    limit = in_storage(app) + 40_000
    ann = Person(app.http, "default", limit)
    shared = ann("POST", f"/v1/models/{MODEL}/shares", json={}).json()["path"]
    formats = [key for key in DOWNLOADS if key != "ply"]

    def ask(index: int) -> httpx.Response:
        if index % 2:
            return app.http.get(f"{shared}/model/download/{formats[index]}")
        return ann("GET", f"/v1/models/{MODEL}/download/{formats[index]}")

    ann("POST", "/v1/captures", json={})  # which notes the limit
    answers = at_once(len(formats), ask)
    check_refused(app, answers, 200, limit)
    for index, answer in enumerate(answers):
        if index % 2 and answer.status_code == 507:
            assert "default" not in answer.text
            assert answer.json()["facts"] == {}


def test_orbit_videos_fail_where_the_quota_ends(app: ServedApp) -> None:
    limit = in_storage(app) + 120_000
    ann = Person(app.http, "default", limit)
    address = f"/v1/models/{MODEL}/orbits"
    wishes = [WISH | {"width": 96 + 2 * step} for step in range(12)]
    made = at_once(12, lambda index: ann("POST", address, json=wishes[index]))
    assert {answer.status_code for answer in made} <= {202, 507}

    def ended() -> bool:
        return not list(app.service.storage.entries(layout.unfinished_kept("orbits")))

    largest = 0
    while not ended():
        largest = max(largest, in_storage(app))
    states = [orbit["state"] for orbit in ann("GET", address).json()["orbits"]]
    failed = [orbit for orbit in ann("GET", address).json()["orbits"] if orbit["state"] == "failed"]
    assert "succeeded" in states
    assert failed
    assert {orbit["problem"]["code"] for orbit in failed} == {"quota_exceeded"}
    assert max(largest, in_storage(app)) <= limit


def test_of_many_uploads_and_captures_at_once_those_that_fit_are_stored(app: ServedApp) -> None:
    limit = in_storage(app) + 60_000
    ann = Person(app.http, "default", limit)
    capture = ann.capture()
    check_refused(app, at_once(16, lambda n: ann.put(capture, f"{n}.jpg", b"x" * 8000)), 201, limit)
    ann.limit = limit = in_storage(app) + 3000
    check_refused(
        app, at_once(16, lambda n: ann("POST", "/v1/captures", json={"name": "n" * 100})), 201, limit
    )
    ann("GET", f"/v1/captures/{capture}")  # which writes a manifest
    assert in_storage(app) <= limit


def test_jobs_and_restarts_reserve_room_until_they_end(app: ServedApp) -> None:
    ann = Person(app.http, "default", in_storage(app) + 2 * JOB_ROOM + 50_000)
    captures = [ann.capture(4000, 4000) for _ in range(5)]
    answers = at_once(5, lambda n: ann("POST", "/v1/jobs", json={"capture": captures[n]}))
    jobs = [answer.json()["id"] for answer in answers if answer.status_code == 202]
    # Two whole rooms, and what is left for a third.
    assert len(jobs) == 3
    assert [answer.json()["code"] for answer in answers if answer.status_code != 202] == [
        "quota_exceeded"
    ] * 2
    ledger = app.service.usage.ledger
    assert ledger.bytes_of("default") <= (ann.limit or 0)
    app.begin(jobs[0])
    app.finish(jobs[0])
    app.service.jobs.list_active()  # which the reaper does
    app.service.usage.scan()
    assert ledger.bytes_of("default") <= 2 * JOB_ROOM + in_storage(app)
    ann.limit = ledger.bytes_of("default")
    problem(ann("POST", f"/v1/jobs/{jobs[0]}/restart"), 507, "quota_exceeded")
    ann.limit += 10
    assert ann("POST", f"/v1/jobs/{jobs[0]}/restart").status_code == 202
    problem(ann("POST", "/v1/jobs", json={"capture": captures[0]}), 507, "quota_exceeded")


def test_a_reservation_that_nobody_ends_is_forgotten(app: ServedApp) -> None:
    clock = Clock(1000.0)
    ledger = app.service.usage.ledger
    ledger.clock = clock
    for field in ("arriving/killed", "job/ended", "work/deleted", "work/ended"):
        ledger.reserve("bob", field, 100, "x", 1000)
    ledger.reserve("bob", "job/runs", 100, "runs", 1000)
    assert ledger.bytes_of("bob") == 500
    ledger.publish(1001.0, ledger.begin_listing(), [], {"runs": True, "ended": False})
    assert ledger.bytes_of("bob") == 300
    ledger.publish(1001.0 + reservations.UPLOAD_SECONDS, ledger.begin_listing(), [], {"ended": False})
    assert ledger.bytes_of("bob") == 100  # what the job has left on its worker's disk
    ledger.deleted(StoredKind.job, "ended", "bob")
    assert ledger.bytes_of("bob") == 0


def test_what_a_scan_counts_of_a_job_is_not_counted_again_in_its_reservation(connection: redis.Redis) -> None:
    reservations.reserve(connection, "bob", reservations.job("j"), 100, folder="j", limit=None)
    connection.hset(keys.stored("bob"), "job/j", '{"kind":"job","id":"j","bytes":30,"derived":10}')
    connection.hset(keys.STORED_TOTALS, "bob", 40)
    assert reservations.used(connection, "bob") == 100
    with pytest.raises(NoRoom) as refused:
        reservations.reserve(connection, "bob", reservations.job("j"), 201, folder="j", limit=200)
    assert (refused.value.used, refused.value.limit, refused.value.size) == (40, 200, 201)
    reservations.reserve(connection, "bob", reservations.job("j"), 200, folder="j", limit=200)
    reservations.settle(connection, "bob", reservations.job("j"), folder="j", stored=150)
    assert reservations.used(connection, "bob") == 150


def test_a_model_that_is_made_while_storage_is_listed_is_counted_once(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk = app.service.storage.walk
    ann = Person(app.http, "default", 10**9)

    def walked(prefix: str) -> list[Entry]:
        entries = list(walk(prefix))
        if prefix == "":
            answer = ann("POST", f"/v1/models/{MODEL}/edits", json={"min_opacity": 1e-6})
            assert answer.status_code == 201, answer.text
        return entries

    ann("POST", "/v1/captures", json={})
    monkeypatch.setattr(app.service.storage, "walk", walked)
    app.service.usage.scan()
    monkeypatch.undo()
    assert app.service.usage.ledger.bytes_of("default") == in_storage(app)
    wait_for(lambda: app.http.get("/readyz").status_code == 200)
