"""Who holds how much: bytes by owner and kind, right after uploads and deletions, and right again after a crash.

Not proved here: S3 itself; moto's server stands for it, and obstore's store in memory where moto is missing.
"""

import json
import threading

import pytest

from splatmill.backplane import keys
from splatmill.backplane.reservations import UPLOAD_SECONDS
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Entry
from splatmill.schema import StoredKind
from splatmill_server.routes import storage as route
from splatmill_server.space import usage as usage_module
from splatmill_server.space.holdings import Holding, sums
from splatmill_server.space.ledger import Ledger
from tests.server.space.conftest import Clock, Person, ServePeople
from tests.support.served_app import ServedApp, problem
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow  # a server for each case


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every request for figures scan storage."""
    monkeypatch.setattr(route, "OLDEST", 0.0)
    monkeypatch.setattr(usage_module, "SCAN_SHARE", 1e9)


def _model(app: ServedApp, job_id: str, owner: str, **more: str) -> int:
    """A finished model with its owner in job.json, as a worker leaves it. Return its size."""
    app.finish(job_id)
    storage = app.service.storage
    record = json.loads(storage.get(layout.job_record(job_id)))
    storage.put(layout.job_record(job_id), json.dumps(record | {"owner": owner} | more).encode())
    wait_for(lambda: storage.exists(layout.job_log(job_id)))  # the end of a job has its log stored
    return sum(entry.size for entry in storage.entries(layout.model(job_id)))


def test_bytes_are_counted_by_owner_and_by_kind(people: ServedApp) -> None:
    ann, bob, chief = (Person(people.http, name) for name in ("ann", "bob", "chief"))
    storage = people.service.storage
    mine, yours = ann.capture(5000, 200), bob.capture(50)
    job_id = ann("POST", "/v1/jobs", json={"capture": mine}).json()["id"]
    storage.put(f"{layout.capture_sfm(mine)}/deep/database.db", b"s" * 70)
    storage.put(f"{layout.job_work(job_id)}/checkpoints/1", b"w" * 30)
    people.begin(job_id)
    model = _model(people, job_id, "ann")
    overhead = sum(
        entry.size
        for entry in storage.entries(layout.capture(mine))
        if "/files/" not in entry.path and "/sfm/" not in entry.path
    )
    log = len(storage.get(layout.job_log(job_id)))
    expected = {
        "captures": 5200 + overhead,
        "sfm": 70,
        "jobs": 30 + log,
        "models": model,
        "uploads": 0,
        "bytes": 5300 + overhead + model + log,
    }
    assert ann.use() == {"ann": expected}
    assert chief.use()["ann"] == expected
    assert set(chief.use()) == {"ann", "bob"}
    assert chief.use("?owner=bob") == bob.use()
    assert bob.use("?owner=ann") == bob.use()
    answer = chief("GET", "/v1/storage?largest=2").json()
    assert [(record["kind"], record["id"]) for record in answer["largest"]] == [
        ("capture", mine),
        ("model", job_id),
    ]
    assert [record["id"] for record in bob("GET", "/v1/storage").json()["largest"]] == [yours]


def test_a_folder_without_a_record_belongs_to_nobody_and_only_admins_see_it(people: ServedApp) -> None:
    people.service.storage.put(f"captures/{'a' * 16}/files/images/x.jpg", b"left over")
    people.service.storage.put(f"jobs/{'b' * 16}/work/x", b"left")
    assert Person(people.http, "chief").use()[None]["bytes"] == 13  # type: ignore[index]  # JSON's null
    assert Person(people.http, "ann").use()["ann"]["bytes"] == 0


def test_an_unfinished_job_is_named_by_what_it_needs(people: ServedApp) -> None:
    ann = Person(people.http, "ann")
    start = ann("POST", "/v1/jobs", json={"capture": (first := ann.capture(5, 5))}).json()["id"]
    people.begin(start)
    _model(people, start, "ann", capture=first)
    second = ann.capture(7, 7)
    running = ann("POST", "/v1/jobs", json={"capture": second, "options": {"start": start}}).json()["id"]
    needed = {
        (record["kind"], record["id"]): record["needed_by"]
        for record in ann("GET", "/v1/storage").json()["largest"]
    }
    assert needed == {
        ("capture", first): None,
        ("capture", second): running,
        ("model", start): running,
        ("job", start): None,
    }


def test_what_a_cancelled_job_left_of_a_model_is_told_from_a_model(people: ServedApp) -> None:
    ann = Person(people.http, "ann")
    jobs = []
    for _ in range(2):
        jobs.append(ann("POST", "/v1/jobs", json={"capture": ann.capture(5, 5)}).json()["id"])
        people.begin(jobs[-1])
    _model(people, jobs[0], "ann")
    people.service.storage.put(f"{layout.model(jobs[1])}/preview.jpg", b"half")
    complete = {
        (record["kind"], record["id"]): record["complete"]
        for record in ann("GET", "/v1/storage").json()["largest"]
        if record["kind"] == "model"
    }
    assert complete == {("model", jobs[0]): True, ("model", jobs[1]): False}


def test_a_capture_was_last_used_when_its_job_was_last_heard_of(people: ServedApp) -> None:
    ann = Person(people.http, "ann")
    capture = ann.capture(5, 5)
    ann.use()
    before = people.service.usage.snapshot()
    key = Holding(kind=StoredKind.capture, id=capture).key
    assert before.last_used[key] == before.holdings[key].modified
    people.begin(job_id := ann("POST", "/v1/jobs", json={"capture": capture}).json()["id"])
    people.redis.xadd(keys.states(job_id), {"g": 1, "a": 1, "e": "{}"}, id="99999999999999-0")
    assert people.service.usage.snapshot().last_used[key] == 99999999999.999


def test_figures_are_right_again_after_redis_has_lost_them(people: ServedApp) -> None:
    ann = Person(people.http, "ann")
    ann.capture(300)
    expected = ann.use()
    people.redis.flushall()
    assert ann.use() == expected
    people.redis.hset(keys.stored("ann"), "capture/x", '{"kind": "capture", "id": "x", "bytes": 999}')
    people.redis.hset(keys.stored("ann"), "capture/y", "what no version writes")
    assert ann.use() == expected


def test_what_is_deleted_during_a_scan_stays_deleted(serve_people: ServePeople) -> None:
    app = serve_people()
    ledger = Ledger(app.redis, clock := Clock(1000.0))
    held = [Holding(kind=StoredKind.capture, id=name, bytes=10, owner="ann") for name in ("kept", "gone")]
    ledger.publish(900.0, 1, held)
    clock.now = 1010.0
    ledger.deleted(StoredKind.capture, "gone", "ann")
    assert ledger.account("ann").bytes == 10
    ledger.publish(1005.0, 1, held)  # it listed storage before the deletion
    assert ledger.account("ann").bytes == 10
    ledger.publish(1020.0, 1, held[:1])
    assert ledger.account("ann").bytes == 10
    assert app.redis.hkeys(keys.stored("ann")) == [b"capture/kept"]
    ledger.publish(1030.0, 1, [])
    assert ledger.owners() == []
    assert not app.redis.exists(keys.stored("ann"))


def test_an_upload_is_counted_until_a_listing_that_began_after_it(serve_people: ServePeople) -> None:
    app = serve_people()
    ledger = Ledger(app.redis, Clock(1000.0))
    ledger.reserve("ann", "arriving/token", 70, "c", None)
    assert ledger.bytes_of("ann") == 70
    first = ledger.begin_listing()
    ledger.publish(1001.0, first, [])
    assert ledger.bytes_of("ann") == ledger.account("ann").bytes == 70
    ledger.settle("ann", "arriving/token", "c", 60)
    assert ledger.stored_since(first) == {"c"}
    held = [Holding(kind=StoredKind.capture, id="c", bytes=60, owner="ann")]
    ledger.publish(1002.0, first, [])
    assert ledger.bytes_of("ann") == ledger.account("ann").bytes == 60
    ledger.publish(1003.0, ledger.begin_listing(), held)
    assert ledger.bytes_of("ann") == ledger.account("ann").bytes == 60
    assert ledger.account("ann").uploads == 0
    ledger.reserve("ann", "arriving/killed", 70, "c", None)
    assert ledger.arriving("ann", "c", 1010.0)
    ledger.publish(1000.0 + UPLOAD_SECONDS + 1, ledger.begin_listing(), held)
    assert ledger.bytes_of("ann") == 60
    assert not ledger.arriving("ann", "c", 1010.0)


def test_a_capture_that_is_written_to_while_storage_is_listed_is_counted_once(
    people: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    ann, usage = Person(people.http, "ann"), people.service.usage
    capture = ann.capture(1000)
    walk = people.service.storage.walk

    def walked(prefix: str) -> list[Entry]:
        entries = list(walk(prefix))
        if prefix == "":
            assert ann.put(capture, "meanwhile.jpg", b"x" * 500).status_code == 201
        return entries

    monkeypatch.setattr(people.service.storage, "walk", walked)
    usage.scan()
    total = sum(entry.size for entry in walk(""))
    assert usage.ledger.bytes_of("ann") == total > 1500


def test_the_records_of_jobs_that_have_rows_are_not_read(
    people: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    ann, usage, storage = Person(people.http, "ann"), people.service.usage, people.service.storage
    capture = ann.capture(50, 60)
    job_id = ann("POST", "/v1/jobs", json={"capture": capture}).json()["id"]
    people.begin(job_id)
    model = _model(people, job_id, "ann", capture=capture)
    paths: list[str] = []
    get = storage.get

    def noted(path: str) -> bytes:
        paths.append(path)
        return get(path)

    monkeypatch.setattr(storage, "get", noted)
    usage.scan()
    assert [path for path in paths if not path.startswith("captures/")] == []
    (held,) = (held for held in usage.account("ann").holdings if held.kind is StoredKind.model)
    assert (held.owner, held.size) == ("ann", model)
    people.redis.flushall()  # the row too: now the record says whose the model is
    usage.scan()
    assert layout.job_record(job_id) in paths
    assert held in usage.account("ann").holdings


def test_scans_take_a_small_share_of_the_time_however_often_figures_are_asked_for(
    serve_people: ServePeople, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = serve_people()
    usage, clock = app.service.usage, Clock(10_000.0)
    usage.ledger.clock = clock
    monkeypatch.setattr(usage_module, "SCAN_SHARE", 0.05)
    app.redis.hset(keys.SCAN, mapping={"began": "9000", "ended": "9100"})
    for now, scanned in ((9150.0, False), (11_099.0, False), (11_101.0, True)):
        clock.now = now
        usage.refresh(10.0)
        last = usage.ledger.last_scan()
        assert last is not None
        assert (last.began == now) is scanned
    clock.now += 9.0
    usage.refresh(10.0)
    last = usage.ledger.last_scan()
    assert last is not None
    assert last.began == 11_101.0


def test_a_scan_that_died_delays_the_next_no_longer_where_the_clock_of_redis_is_set_back(
    serve_people: ServePeople,
) -> None:
    app = serve_people()
    app.service.usage.scan()
    app.redis.set(keys.SCAN_LOCK, "a process that was killed", ex=1800)  # as seen after half an hour back
    app.service.usage.refresh(-1.0)
    assert 0 < app.redis.ttl(keys.SCAN_LOCK) <= 30


def test_of_two_processes_that_know_nothing_one_scans_and_the_other_waits(
    serve_people: ServePeople, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = serve_people().service.usage, serve_people().service.usage
    monkeypatch.setattr(usage_module, "SCAN_SHARE", 0.05)
    scanning, go_on, scans = threading.Event(), threading.Event(), []
    scan = one.scan

    def slow(lock: object) -> None:
        scans.append("one")
        scanning.set()
        assert go_on.wait(60)
        scan()

    monkeypatch.setattr(one, "scan", slow)
    monkeypatch.setattr(two, "scan", lambda lock: scans.append("two"))
    first = threading.Thread(target=one.refresh, args=(10.0,))
    second = threading.Thread(target=two.refresh, args=(10.0,))
    first.start()
    assert scanning.wait(60)
    second.start()
    go_on.set()
    first.join(60)
    second.join(60)
    assert scans == ["one"]


def test_only_folders_of_records_are_counted() -> None:
    from datetime import UTC, datetime

    def entry(path: str) -> Entry:
        return Entry(path, 1, "", datetime.fromtimestamp(5, UTC))

    name = "a" * 16
    totals = sums(
        entry(path)
        for path in (
            f"models/{name}/job.json",
            f"models/{name}/x/job.json",
            "keys/1",
            "models/UP/x",
            "health/1",
        )
    )
    assert list(totals) == [(StoredKind.model, name)]
    assert totals[StoredKind.model, name].whole
    assert (totals[StoredKind.model, name].files, totals[StoredKind.model, name].modified) == (2, 5.0)


def test_redis_out_of_reach_is_a_problem_document(serve_people: ServePeople) -> None:
    app = serve_people(redis_url="unix:///nowhere.sock")
    problem(app.http.get("/v1/storage"), 503, "queue_unavailable")
