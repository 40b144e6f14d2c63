"""What a sweep deletes at its age, what it keeps, and what has no record. The clock is moved, not waited for.

Not proved here: deletions that meet new jobs (test_deletion), and the folders of workers (tests/worker/service).
"""

import time

import pytest
import redis

from splatmill.backplane import keys
from splatmill.backplane.jobs import events
from splatmill.backplane.storage import layout
from splatmill.schema import JobState, LogEvent, Problem, StateEvent
from splatmill_server.background.sweeper import Sweeper
from splatmill_server.space.retention import Ages
from splatmill_server.space.usage import Usage
from tests.server.space.conftest import Clock, Person, ServePeople, as_object_store
from tests.support.served_app import ServedApp, stored
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow  # a server for each case

DAY = 86400.0


def failed(app: ServedApp, capture: str) -> str:
    job_id = app.job(capture)
    app.begin(job_id)
    problem = Problem.of("sfm_failed", "The cameras could not be recovered.")
    app.say(job_id, StateEvent(state=JobState.failed, problem=problem))
    retire(app, job_id)
    return job_id


def succeeded(app: ServedApp, capture: str) -> str:
    job_id = app.job(capture)
    app.begin(job_id)
    app.finish(job_id)
    retire(app, job_id)
    return job_id


def retire(app: ServedApp, job_id: str) -> None:
    """Let the reaper retire a job that has ended, or another thread that does so already."""
    app.service.jobs.list_active()
    wait_for(lambda: not app.service.storage.exists(layout.unfinished_job(job_id)))


def sweep(app: ServedApp, days: float = 0.0, **ages: float) -> list[tuple[str, str]]:
    """Sweep as if these days had passed; return what was deleted."""
    app.service.usage.scan()
    app.service.usage.ledger.clock = Clock(time.time() + days * DAY)
    app.service.sweeper.ages = Ages(**{name: count * DAY for name, count in ages.items()})
    # What a request shows beforehand is what the sweep then does.
    chief = Person(app.http, "chief")
    shown = [
        (deletion["kind"], deletion["id"]) for deletion in chief("GET", "/v1/storage").json()["deletions"]
    ]
    deleted: list[tuple[str, str]] = [
        (deletion.action, deletion.held.id) for deletion in app.service.sweeper.sweep()
    ]
    app.service.usage.ledger.clock = app.service.usage.ledger._redis_time
    assert deleted == shown
    return deleted


def paths(app: ServedApp) -> list[str]:
    return sorted(entry.path for entry in app.service.storage.walk(""))


def test_nothing_is_deleted_without_an_age(people: ServedApp) -> None:
    capture = people.capture()
    failed(people, capture)
    succeeded(people, capture)
    before = paths(people)
    assert sweep(people, days=4000) == []
    assert paths(people) == before


def test_a_capture_is_deleted_at_its_age_counted_from_its_last_job(people: ServedApp) -> None:
    capture = people.capture()
    job_id = people.job(capture)
    assert sweep(people, days=50, captures=30) == []  # an unfinished job needs it
    people.begin(job_id)
    people.finish(job_id)
    later = int((time.time() + 20 * DAY) * 1000)
    people.redis.xadd(keys.states(job_id), {"g": 1, "a": 1, "e": "{}"}, id=f"{later}-0")
    assert sweep(people, days=45, captures=30) == []
    assert sweep(people, days=51, captures=30) == [("capture", capture)]
    assert not any(path.startswith("captures/") for path in paths(people))
    assert people.http.get(f"/v1/models/{job_id}").status_code == 200
    assert sweep(people, days=51, captures=30) == []


def test_an_upload_that_arrives_keeps_its_capture(people: ServedApp) -> None:
    capture = people.capture()
    service = people.service
    service.usage.scan()
    snapshot_age = Ages(captures=30 * DAY)

    service.sweeper.ages = snapshot_age
    service.usage.ledger.clock = Clock(time.time() + 40 * DAY)
    service.usage.ledger.reserve("default", "arriving/x", 1, capture, None)
    assert service.sweeper.sweep() == []
    service.usage.ledger.settle("default", "arriving/x", capture, 0)
    assert [deletion.held.id for deletion in service.sweeper.sweep()] == [capture]


def test_a_failed_job_leaves_with_its_row_its_log_and_all_its_keys(people: ServedApp) -> None:
    capture = people.capture()
    job_id, model = failed(people, capture), succeeded(people, capture)
    people.say(job_id, LogEvent(level="info", message="late"))
    people.service.storage.put(f"{layout.job_work(job_id)}/checkpoints/1", b"w")
    assert sweep(people, days=6, failed_jobs=7) == []
    assert sweep(people, days=8, failed_jobs=7) == [("job", job_id)]
    assert not any(job_id in path for path in paths(people))
    assert people.redis.exists(*keys.of_job(job_id)) == 0
    assert people.redis.zrange(keys.JOBS, 0, -1) == [model.encode()]
    assert people.http.get(f"/v1/models/{model}").status_code == 200


def test_a_failed_job_that_redis_has_lost_leaves_with_its_log(people: ServedApp) -> None:
    job_id = failed(people, people.capture())
    people.redis.flushall()
    assert people.http.get(f"/v1/jobs/{job_id}").json()["state"] == "failed"
    assert sweep(people, days=8, failed_jobs=7) == [("job", job_id)]
    assert not any(job_id in path for path in paths(people))


def test_a_job_without_any_file_leaves_too(people: ServedApp) -> None:
    job_id = people.job(people.capture())
    people.http.post(f"/v1/jobs/{job_id}/cancel")
    people.service.reaper.tick()
    people.service.jobs.list_active()
    people.service.storage.delete_prefix(layout.job(job_id))
    assert people.state(job_id) == "cancelled"
    assert sweep(people, days=8, failed_jobs=7) == [("job", job_id)]
    assert people.redis.exists(keys.job(job_id)) == 0


def test_work_files_leave_before_their_job(people: ServedApp) -> None:
    capture = people.capture()
    job_id, waiting = failed(people, capture), people.job(capture)
    for name in (job_id, waiting):
        people.service.storage.put(f"{layout.job_work(name)}/checkpoints/1", b"w")
    assert sweep(people, days=3, work=2, failed_jobs=30) == [("work", job_id)]
    assert [path for path in paths(people) if "/work/" in path] == [
        f"{layout.job_work(waiting)}/checkpoints/1"
    ]
    assert people.state(job_id) == "failed"


def test_models_leave_only_if_an_age_is_set_and_no_job_starts_from_them(people: ServedApp) -> None:
    capture = people.capture()
    model = succeeded(people, capture)
    assert sweep(people, days=100, failed_jobs=1, work=1) == []
    job_id = people.job(capture, start=model)
    assert sweep(people, days=100, models=90) == []
    people.http.post(f"/v1/jobs/{job_id}/cancel")
    people.service.reaper.tick()
    assert sweep(people, days=100, models=90) == [("job", model)]
    assert not any(model in path for path in paths(people))


def test_a_row_that_cannot_be_read_keeps_everything_it_may_need(people: ServedApp) -> None:
    capture, model = people.capture(), succeeded(people, people.capture())
    job_id = people.job(capture)
    people.redis.hset(keys.job(job_id), "options", "what a later version writes")
    assert sweep(people, days=100, captures=1, models=1, failed_jobs=1) == []
    assert people.http.get(f"/v1/models/{model}").status_code == 200


def test_folders_without_a_record_are_deleted_after_a_grace(people: ServedApp) -> None:
    capture = people.capture()
    unfinished, model, broken = people.job(capture), succeeded(people, capture), failed(people, capture)
    storage = people.service.storage
    orphans = [
        f"captures/{'a' * 16}/files/images/x.jpg",
        f"models/{'b' * 16}/model.ply",
        f"jobs/{'c' * 16}/work/x",
    ]
    kept = [
        f"models/{unfinished}/preview.jpg",
        f"models/{broken}/preview.jpg",
        f"jobs/{unfinished}/work/x",
        f"jobs/{model}/work/x",
        "of-another-program/x",
    ]
    for path in (*orphans, *kept):
        storage.put(path, b"x")
    assert sweep(people, days=0.9) == []
    deletions = sweep(people, days=1.1)
    assert sorted(deletions) == [("orphan", "a" * 16), ("orphan", "b" * 16), ("orphan", "c" * 16)]
    assert not set(orphans) & set(paths(people))
    assert set(kept) <= set(paths(people))
    assert people.http.get(f"/v1/captures/{capture}").json()["files"]


def test_what_is_written_to_since_the_plan_stays(people: ServedApp, monkeypatch: pytest.MonkeyPatch) -> None:
    people.service.storage.put(f"models/{'b' * 16}/model.ply", b"x")
    people.service.usage.scan()
    snapshot = Usage.snapshot

    def then_written(self: Usage) -> object:
        figures = snapshot(self)
        time.sleep(0.01)  # so that its time of modification differs
        people.service.storage.put(f"models/{'b' * 16}/report.json", b"x")
        return figures

    monkeypatch.setattr(Usage, "snapshot", then_written)
    people.service.usage.ledger.clock = Clock(time.time() + 2 * DAY)
    people.redis.hset(keys.SCAN, "ended", str(time.time() + 2 * DAY))
    assert people.service.sweeper.sweep() == []


def test_a_sweep_deletes_a_bounded_number_and_the_next_one_goes_on(
    people: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatmill_server.background.sweeper.MOST", 2)
    monkeypatch.setattr("splatmill_server.routes.storage.MOST", 2)
    captures = [people.capture() for _ in range(3)]
    first, second = sweep(people, days=9, captures=7), sweep(people, days=9, captures=7)
    assert (len(first), len(second)) == (2, 1)
    assert {capture_id for _, capture_id in first + second} == set(captures)


def test_one_process_sweeps_per_interval(serve_people: ServePeople) -> None:
    sweepers: list[Sweeper] = [serve_people().service.sweeper for _ in range(3)]
    assert [sweeper._is_turn() for sweeper in sweepers] == [True, False, False]
    assert 0 < sweepers[0].connection.pttl(keys.SWEPT) <= 540_000


def test_an_owner_sees_its_own_deletions_and_when_records_expire(serve_people: ServePeople) -> None:
    app = serve_people(keep_captures="30d")
    ann, bob = Person(app.http, "ann"), Person(app.http, "bob")
    capture = ann.capture(5, 5)
    [record] = ann("GET", "/v1/storage").json()["largest"]
    assert record["expires_at"] > record["last_used"]
    app.service.usage.scan()
    app.service.usage.ledger.clock = Clock(time.time() + 31 * DAY)
    [planned] = ann("GET", "/v1/storage").json()["deletions"]
    assert (planned["kind"], planned["id"], planned["owner"]) == ("capture", capture, "ann")
    assert planned["reason"] == "It was not used for 30 days."
    assert bob("GET", "/v1/storage").json()["deletions"] == []


def test_keys_of_jobs_without_a_row_are_deleted_and_rows_are_listed_again(people: ServedApp) -> None:
    connection: redis.Redis = people.redis
    job_id = people.job()
    gone = "d" * 16
    events.append(connection, gone, 1, 1, LogEvent(level="info", message="too late"))
    connection.zadd(keys.JOBS, {gone: 5})
    connection.zrem(keys.JOBS, job_id)
    search = people.service.sweeper
    search.ages = Ages(orphans=3600.0)
    search.search()
    assert connection.zrange(keys.JOBS, 0, -1) == [job_id.encode()]
    assert [job["id"] for job in people.http.get("/v1/jobs").json()["jobs"]] == [job_id]
    assert [key for key in connection.keys("*") if gone.encode() in key]  # not idle for long
    search.ages = Ages(orphans=0.0)
    search.search()
    assert not [key for key in connection.keys("*") if gone.encode() in key]
    assert people.state(job_id) == "queued"


def test_digests_without_files_and_broken_writes_are_deleted(serve_people: ServePeople) -> None:
    app = serve_people()
    capture, storage = app.capture("a.jpg"), app.service.storage
    whole = stored(app)
    storage.put(f"captures/{capture}/sha256/images/never/came.jpg", b"0" * 64)
    assert storage.root is not None
    (storage.root / f"models/{'e' * 16}").mkdir(parents=True)
    (storage.root / f"models/{'e' * 16}/model.ply#1").write_bytes(b"half")
    app.service.sweeper.search()
    assert len(stored(app)) == len(whole) + 2  # younger than a day
    app.service.sweeper.ages = Ages(orphans=0.0)
    app.service.sweeper.search()
    assert stored(app) == whole


def test_a_digest_that_an_upload_takes_up_is_kept(
    serve_people: ServePeople, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = serve_people()
    as_object_store(app.service.storage)
    capture, storage = app.capture("a.jpg"), app.service.storage
    path, file = f"captures/{capture}/sha256/images/late.jpg", f"captures/{capture}/files/images/late.jpg"
    storage.put(path, b"5" * 64)
    delete = storage.delete

    def meanwhile(name: str) -> None:
        delete(name)
        if name == path:
            storage.put(file, b"late")

    monkeypatch.setattr(storage, "delete", meanwhile)
    app.service.sweeper.ages = Ages(orphans=0.0)
    app.service.sweeper.search()
    assert storage.get(path) == b"5" * 64
