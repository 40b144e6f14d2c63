"""The bin over real HTTP: no list shows what is in it, it can be restored for a day, and is deleted for good then.

Not proved here: how the page shows it (tests/browser/test_lists.py).
"""

from datetime import UTC, datetime, timedelta

import pytest

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.schema import BinKind, JobState, StateEvent
from tests.support.served_app import Serve, ServedApp, problem


def ended(app: ServedApp, capture: str | None = None) -> str:
    """A job that has ended, with its model."""
    job_id = app.job(capture)
    app.begin(job_id)
    app.finish(job_id)
    app.service.reaper.tick()
    return job_id


def listed(app: ServedApp, noun: str) -> list[str]:
    return [entry["id"] for entry in app.http.get(f"/v1/{noun}").json()[noun]]


def in_bin(app: ServedApp) -> list[tuple[str, str]]:
    return [(entry["kind"], entry["id"]) for entry in app.http.get("/v1/bin").json()["entries"]]


def after_a_day(app: ServedApp, seconds: float = 1) -> set[str]:
    """What the sweeper deletes of the bin a day later, or `seconds` from then."""
    moment = datetime.now(UTC) + timedelta(days=1, seconds=seconds)
    return {entry.id for entry in app.service.bin.delete_due(moment)}


def test_no_list_shows_what_is_in_the_bin_and_it_can_be_restored(app: ServedApp) -> None:
    capture = app.capture()
    job_id, other = ended(app, capture), ended(app)
    binned = app.http.put(f"/v1/bin/jobs/{job_id}").json()
    assert (binned["kind"], binned["model"]) == ("job", job_id)
    kept = datetime.fromisoformat(binned["deleted_at"]) - datetime.fromisoformat(binned["binned_at"])
    assert kept == timedelta(days=1)
    assert app.http.put(f"/v1/bin/captures/{capture}").status_code == 200
    assert app.http.put(f"/v1/bin/jobs/{job_id}").json() == binned, "it stays as it is"
    assert in_bin(app) == [("capture", capture), ("job", job_id)]
    assert listed(app, "jobs") == listed(app, "models") == [other]
    assert capture not in listed(app, "captures")
    assert app.http.get(f"/v1/models/{job_id}/files/model.ply").status_code == 200, (
        "its address still answers"
    )
    for path in (f"jobs/{job_id}", f"captures/{capture}"):
        assert app.http.delete(f"/v1/bin/{path}").status_code == 204
        problem(app.http.delete(f"/v1/bin/{path}"), 404, "not_in_bin")
    assert in_bin(app) == []
    assert set(listed(app, "models")) == {job_id, other}
    assert capture in listed(app, "captures")
    assert after_a_day(app) == set()


def test_it_is_deleted_for_good_a_day_later_and_not_before(app: ServedApp) -> None:
    capture = app.capture()
    job_id = ended(app, capture)
    app.http.put(f"/v1/bin/jobs/{job_id}")
    app.http.put(f"/v1/bin/captures/{capture}")
    assert after_a_day(app, seconds=-60) == set()
    assert after_a_day(app) == {job_id, capture}
    assert in_bin(app) == []
    problem(app.http.get(f"/v1/jobs/{job_id}"), 404, "job_not_found")
    problem(app.http.get(f"/v1/captures/{capture}"), 404, "capture_not_found")
    assert list(app.service.storage.entries(layout.bin_folder())) == []


def test_redis_may_lose_it(app: ServedApp) -> None:
    job_id, other = ended(app), ended(app)
    app.http.put(f"/v1/bin/jobs/{job_id}")
    app.redis.flushall()
    app.service.reaper.tick()
    assert listed(app, "models") == [other]
    assert in_bin(app) == [("job", job_id)]
    app.redis.delete(keys.BIN)  # this alone, as by a Redis that was killed in the second after
    assert after_a_day(app) == {job_id}


def test_what_was_restored_while_redis_was_away_is_not_in_the_bin(app: ServedApp) -> None:
    job_id = ended(app)
    app.http.put(f"/v1/bin/jobs/{job_id}")
    app.service.storage.delete(layout.binned(BinKind.job, job_id))
    assert after_a_day(app) == set()
    assert listed(app, "models") == [job_id]


def test_links_to_its_model_open_nothing_until_it_is_restored(app: ServedApp) -> None:
    job_id = ended(app)
    path = app.http.post(f"/v1/models/{job_id}/shares", json={}).json()["path"]
    assert app.http.get(f"{path}/model").status_code == 200
    app.http.put(f"/v1/bin/jobs/{job_id}")
    problem(app.http.get(f"{path}/model"), 404, "share_not_found")
    app.http.delete(f"/v1/bin/jobs/{job_id}")
    assert app.http.get(f"{path}/model").status_code == 200


def test_what_a_job_uses_is_refused(app: ServedApp) -> None:
    capture, start = app.capture(), ended(app)
    running = app.job(capture, start=start)
    problem(app.http.put(f"/v1/bin/jobs/{running}"), 409, "job_running")
    problem(app.http.put(f"/v1/bin/captures/{capture}"), 409, "capture_in_use")
    problem(app.http.put(f"/v1/bin/jobs/{start}"), 409, "model_in_use")
    problem(app.http.put("/v1/bin/jobs/0123456789abcdef"), 404, "job_not_found")
    problem(app.http.put("/v1/bin/captures/0123456789abcdef"), 404, "capture_not_found")
    assert in_bin(app) == []


def test_a_job_takes_what_it_uses_out_of_the_bin(app: ServedApp) -> None:
    capture, start = app.capture(), ended(app)
    failed = app.job(capture)
    app.begin(failed)
    app.say(failed, StateEvent(state=JobState.failed))
    app.service.reaper.tick()
    for path in (f"jobs/{start}", f"jobs/{failed}", f"captures/{capture}"):
        assert app.http.put(f"/v1/bin/{path}").status_code == 200
    app.job(capture, start=start)
    assert in_bin(app) == [("job", failed)]
    assert app.http.post(f"/v1/jobs/{failed}/restart").status_code == 202
    assert in_bin(app) == []


def test_a_record_that_is_deleted_by_itself_leaves_the_bin(app: ServedApp) -> None:
    job_id = ended(app)
    app.http.put(f"/v1/bin/jobs/{job_id}")
    assert app.http.delete(f"/v1/jobs/{job_id}").status_code == 204
    assert in_bin(app) == []
    assert after_a_day(app) == set()


@pytest.mark.parametrize("damage", [b"", b"{", b"[]", b'{"kind": "key", "id": "x"}'])
def test_a_damaged_record_deletes_nothing(app: ServedApp, damage: bytes) -> None:
    job_id = ended(app)
    app.http.put(f"/v1/bin/jobs/{job_id}")
    app.service.storage.put(layout.binned(BinKind.job, job_id), damage)
    app.redis.delete(keys.BIN)
    assert after_a_day(app) == set()
    assert listed(app, "models") == [job_id]


def test_each_owner_has_a_bin(serve: Serve) -> None:
    app = serve(api_key="first-admin-key-0123456789")
    owners = {}
    for owner in ("ann", "bob"):
        body = {"name": owner, "owner": owner, "scopes": ["read", "train"]}
        secret = app.http.post("/v1/keys", json=body).json()["secret"]
        owners[owner] = {"Authorization": f"Bearer {secret}"}
    capture = app.http.post("/v1/captures", json={}, headers=owners["ann"]).json()["id"]
    problem(app.http.put(f"/v1/bin/captures/{capture}", headers=owners["bob"]), 404, "capture_not_found")
    assert app.http.put(f"/v1/bin/captures/{capture}", headers=owners["ann"]).status_code == 200
    problem(app.http.delete(f"/v1/bin/captures/{capture}", headers=owners["bob"]), 404, "capture_not_found")
    bins = {owner: app.http.get("/v1/bin", headers=sent).json()["entries"] for owner, sent in owners.items()}
    assert ([entry["id"] for entry in bins["ann"]], bins["bob"]) == ([capture], [])
