"""A job and its model are named anew: at any time, over the loss of Redis, and without a way into names of files."""

import pytest

from splatmill.backplane.storage import layout
from splatmill.schema import JobState, StateEvent
from tests.support.served_app import ServedApp, problem, store_model


def named(app: ServedApp, job_id: str) -> tuple[str | None, ...]:
    """The name of a job and its model, by themselves and in the lists."""
    paths = [f"/v1/jobs/{job_id}", f"/v1/models/{job_id}"]
    alone = [app.http.get(path).json()["name"] for path in paths]
    listed = [
        entry["name"]
        for noun in ("jobs", "models")
        for entry in app.http.get(f"/v1/{noun}").json()[noun]
        if entry["id"] == job_id
    ]
    return (*alone, *listed)


@pytest.fixture
def model_id(app: ServedApp) -> str:
    job_id = app.job()
    app.begin(job_id)
    app.finish(job_id)
    app.service.reaper.tick()
    return job_id


@pytest.mark.parametrize("noun", ["jobs", "models"])
@pytest.mark.parametrize("name", ["Fuchs im Schnee", "雪の狐 🦊", "a/b\\c", "x" * 200])
def test_a_job_and_its_model_are_named_together(app: ServedApp, model_id: str, noun: str, name: str) -> None:
    assert app.http.get("/v1/models").json()["models"], "the list keeps what it has read"
    answer = app.http.patch(f"/v1/{noun}/{model_id}", json={"name": name})
    assert (answer.status_code, answer.json()["name"]) == (200, name)
    assert named(app, model_id) == (name,) * 4
    by_name = app.http.get("/v1/models", params={"name": name}).json()["models"]
    assert [model["id"] for model in by_name] == [model_id]
    assert app.http.patch(f"/v1/{noun}/{model_id}", json={"name": None}).json()["name"] is None
    assert named(app, model_id) == (None,) * 4


def test_the_name_outlasts_redis(app: ServedApp, model_id: str) -> None:
    waits, failed = app.job(), app.job()
    app.begin(failed)
    app.say(failed, StateEvent(state=JobState.failed))
    app.service.reaper.tick()
    for job_id, name in ((model_id, "whole"), (waits, "waits"), (failed, "failed")):
        assert app.http.patch(f"/v1/jobs/{job_id}", json={"name": name}).status_code == 200
    app.redis.flushall()
    app.service.reaper.tick()
    assert named(app, model_id) == ("whole",) * 4
    assert [app.http.get(f"/v1/jobs/{job_id}").json()["name"] for job_id in (waits, failed)] == [
        "waits",
        "failed",
    ]


def test_a_model_has_the_name_that_its_job_was_given_while_it_ran(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    assert app.http.patch(f"/v1/jobs/{job_id}", json={"name": "later"}).json()["name"] == "later"
    problem(app.http.patch(f"/v1/models/{job_id}", json={"name": "x"}), 409, "model_not_ready")
    store_model(app.service, job_id, name="as the attempt began")
    app.say(job_id, StateEvent(state=JobState.succeeded))
    app.service.reaper.tick()
    assert named(app, job_id) == ("later",) * 4


@pytest.mark.parametrize("name", ["line\nbreak", "y" * 201, 7])
def test_what_is_no_name_changes_nothing(app: ServedApp, model_id: str, name: object) -> None:
    assert app.http.patch(f"/v1/models/{model_id}", json={"name": name}).status_code == 422
    assert app.http.patch(f"/v1/models/{model_id}", json={}).status_code == 422
    assert named(app, model_id) == (None,) * 4


def test_a_damaged_record_leaves_the_first_name(app: ServedApp) -> None:
    job_id = app.http.post("/v1/jobs", json={"capture": app.capture(), "name": "first"}).json()["id"]
    app.begin(job_id)
    store_model(app.service, job_id, name="first")
    app.say(job_id, StateEvent(state=JobState.succeeded))
    for damage in (
        b"",
        b"{",
        b"[]",
        b'{"format": 1, "name": 3}',
        b'{"format": 99, "name": "x"}',
    ):
        app.service.storage.put(layout.job_name(job_id), damage)
        assert app.http.get(f"/v1/models/{job_id}").json()["name"] == "first"


def test_unknown_and_deleted_jobs_get_no_name(app: ServedApp, model_id: str) -> None:
    problem(app.http.patch("/v1/jobs/0123456789abcdef", json={"name": "x"}), 404, "job_not_found")
    problem(app.http.patch("/v1/models/0123456789abcdef", json={"name": "x"}), 404, "model_not_found")
    app.http.patch(f"/v1/jobs/{model_id}", json={"name": "x"})
    assert app.http.delete(f"/v1/jobs/{model_id}").status_code == 204
    assert not app.service.storage.exists(layout.job_name(model_id))
    problem(app.http.patch(f"/v1/jobs/{model_id}", json={"name": "x"}), 404, "job_not_found")
    assert not app.service.storage.exists(layout.job_name(model_id))


@pytest.mark.parametrize(
    ("name", "saved"),
    [
        ("Fuchs im Schnee", "Fuchs%20im%20Schnee.ply"),
        ("雪", "%E9%9B%AA.ply"),
        ("../../etc/passwd", "etc-passwd.ply"),
        ('a"b:c?', "a-b-c.ply"),
        ("x" * 200, "x" * 60 + ".ply"),
    ],
)
def test_files_are_saved_under_the_name(app: ServedApp, model_id: str, name: str, saved: str) -> None:
    app.http.patch(f"/v1/models/{model_id}", json={"name": name})
    answer = app.http.get(f"/v1/models/{model_id}/files/model.ply")
    assert answer.headers["content-disposition"] == f"attachment; filename*=UTF-8''{saved}"


@pytest.mark.parametrize("name", [None, "...", "//"])
def test_files_without_a_name_are_saved_under_the_id(app: ServedApp, model_id: str, name: str | None) -> None:
    app.http.patch(f"/v1/models/{model_id}", json={"name": name})
    answer = app.http.get(f"/v1/models/{model_id}/files/model.ply")
    assert answer.headers["content-disposition"].endswith(f"''{model_id}.ply")
