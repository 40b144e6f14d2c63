"""A job and its model get names, tags and stars: at any time, over the loss of Redis, and without a way into names of
files. Lists are filtered by them, and lists of models are sorted.
"""

import json
from concurrent.futures import ThreadPoolExecutor

import pytest

from splatmill.backplane.storage import layout
from splatmill.schema import JobState, StateEvent
from splatmill_server.jobs import ranking
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
        app.service.storage.put(layout.job_labels(job_id), damage)
        assert app.http.get(f"/v1/models/{job_id}").json()["name"] == "first"


def test_unknown_and_deleted_jobs_get_no_name(app: ServedApp, model_id: str) -> None:
    problem(app.http.patch("/v1/jobs/0123456789abcdef", json={"name": "x"}), 404, "job_not_found")
    problem(app.http.patch("/v1/models/0123456789abcdef", json={"name": "x"}), 404, "model_not_found")
    app.http.patch(f"/v1/jobs/{model_id}", json={"name": "x"})
    assert app.http.delete(f"/v1/jobs/{model_id}").status_code == 204
    assert not app.service.storage.exists(layout.job_labels(model_id))
    problem(app.http.patch(f"/v1/jobs/{model_id}", json={"name": "x"}), 404, "job_not_found")
    assert not app.service.storage.exists(layout.job_labels(model_id))


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


def labels(app: ServedApp, job_id: str) -> list[tuple[object, ...]]:
    """The labels of a job and its model, by themselves and in the lists."""
    entries = [app.http.get(f"/v1/{noun}/{job_id}").json() for noun in ("jobs", "models")]
    for noun in ("jobs", "models"):
        entries += [entry for entry in app.http.get(f"/v1/{noun}").json()[noun] if entry["id"] == job_id]
    return [(entry["name"], entry["tags"], entry["favourite"]) for entry in entries]


@pytest.mark.parametrize("noun", ["jobs", "models"])
def test_tags_and_stars_are_given_by_themselves_and_outlast_redis(
    app: ServedApp, model_id: str, noun: str
) -> None:
    address = f"/v1/{noun}/{model_id}"
    assert labels(app, model_id) == [(None, [], False)] * 4
    tags = [" Garten ", "雪", "garten", "a b"]
    answer = app.http.patch(address, json={"tags": tags}).json()
    assert (answer["name"], answer["tags"], answer["favourite"]) == (None, ["Garten", "雪", "a b"], False)
    app.http.patch(address, json={"favourite": True})
    app.http.patch(address, json={"name": "x"})
    for _ in range(2):
        assert labels(app, model_id) == [("x", ["Garten", "雪", "a b"], True)] * 4
        app.redis.flushall()
        app.service.reaper.tick()
    app.http.patch(address, json={"favourite": False, "tags": []})
    assert labels(app, model_id) == [("x", [], False)] * 4


@pytest.mark.parametrize(
    "wrong",
    [
        {"tags": ["a,b"]},
        {"tags": [" "]},
        {"tags": ["x" * 41]},
        {"tags": ["line\nbreak"]},
        {"tags": [str(number) for number in range(13)]},
        {"tags": "one"},
        {"tags": None},
        {"favourite": "perhaps"},
        {"star": True},
    ],
)
def test_what_is_no_label_changes_nothing(app: ServedApp, model_id: str, wrong: dict[str, object]) -> None:
    app.http.patch(f"/v1/jobs/{model_id}", json={"tags": ["kept"], "favourite": True})
    assert app.http.patch(f"/v1/jobs/{model_id}", json=wrong).status_code == 422
    assert labels(app, model_id) == [(None, ["kept"], True)] * 4


def test_two_labels_at_once_are_both_kept(app: ServedApp, model_id: str) -> None:
    address = f"/v1/models/{model_id}"
    for number in range(5):
        changes = [{"name": f"n{number}"}, {"tags": [f"t{number}"]}, {"favourite": number % 2 == 0}]
        with ThreadPoolExecutor(3) as pool:
            list(pool.map(lambda change: app.http.patch(address, json=change), changes))
        assert labels(app, model_id) == [(f"n{number}", [f"t{number}"], number % 2 == 0)] * 4


@pytest.fixture
def several(app: ServedApp) -> dict[str, str]:
    """Models by their names, made in the order of the names."""
    made = {}
    facts = {"b": (24.0, 900), "A": (None, 400), "c": (31.5, 100), "": (27.0, 2000)}
    for name, (psnr, count) in facts.items():
        job_id = app.job()
        app.begin(job_id)
        store_model(app.service, job_id, name=name or None)
        report = {"curve": [{"seconds": 1.0, "step": 1, "psnr": psnr, "gaussians": 2}], "seconds": {}}
        app.service.storage.put(layout.model_file(job_id, "report.json"), json.dumps(report).encode())
        ply = layout.model_file(job_id, "model.ply")
        app.service.storage.put(ply, app.service.storage.get(ply) + bytes(count))
        app.say(job_id, StateEvent(state=JobState.succeeded))
        made[name] = job_id
    app.service.reaper.tick()
    return made


def names_of(app: ServedApp, noun: str, names: dict[str, str], **query: str | bool) -> list[str]:
    """The names of the records of a list, read over pages of three."""
    all_names: list[str] = []
    asked: dict[str, str | bool | int] = {**query, "limit": 3}
    while True:
        page = app.http.get(f"/v1/{noun}", params=asked).json()
        all_names += [names[record["id"]] for record in page[noun]]
        if page["cursor"] is None:
            return all_names
        asked["cursor"] = page["cursor"]


def test_jobs_are_sorted_over_pages_and_those_without_a_model_come_last(
    app: ServedApp, several: dict[str, str]
) -> None:
    names = {job_id: name for name, job_id in several.items()}
    names |= {app.job(): name for name in ("waits a", "Waits B")}
    for job_id, name in names.items():
        app.http.patch(f"/v1/jobs/{job_id}", json={"name": name or None})

    def listed(**query: str | bool) -> list[str]:
        return names_of(app, "jobs", names, **query)

    assert listed() == listed(sort="newest") == ["Waits B", "waits a", "", "c", "A", "b"]
    assert listed(sort="name") == ["A", "b", "c", "waits a", "Waits B", ""]
    assert listed(sort="size") == ["", "b", "A", "c", "Waits B", "waits a"]
    assert listed(sort="psnr") == ["c", "", "b", "Waits B", "waits a", "A"]
    assert listed(sort="size", state="queued") == ["Waits B", "waits a"]
    assert listed(sort="psnr", state="succeeded") == ["c", "", "b", "A"]
    app.http.patch(f"/v1/jobs/{several['b']}", json={"tags": ["best"], "favourite": True})
    assert listed(sort="psnr", tag="BEST") == listed(sort="name", favourite=True) == ["b"]
    assert app.http.get("/v1/jobs", params={"sort": "colour"}).status_code == 422


def test_models_are_sorted_over_pages(app: ServedApp, several: dict[str, str]) -> None:
    names = {model_id: name for name, model_id in several.items()}

    def listed(**query: str | bool) -> list[str]:
        return names_of(app, "models", names, **query)

    assert listed(sort="newest") == ["", "c", "A", "b"]
    assert listed(sort="name") == ["A", "b", "c", ""]
    assert listed(sort="size") == ["", "b", "A", "c"]
    assert listed(sort="psnr") == ["c", "", "b", "A"]
    app.http.patch(f"/v1/models/{several['b']}", json={"tags": ["Best"], "favourite": True})
    app.http.patch(f"/v1/models/{several['c']}", json={"tags": ["best", "x"]})
    for order in ("newest", "name"):
        assert sorted(listed(sort=order, tag="BEST")) == ["b", "c"]
        assert listed(sort=order, tag="bes") == []
        assert listed(sort=order, favourite=True) == ["b"]
        assert listed(sort=order, favourite=False, tag="best") == ["c"]
    jobs = app.http.get("/v1/jobs", params={"tag": "best", "favourite": True, "state": "succeeded"}).json()
    assert [job["id"] for job in jobs["jobs"]] == [several["b"]]
    app.redis.flushall()
    assert listed(favourite=True) == ["b"], "the labels of models that were not read are known"
    assert app.http.get("/v1/models", params={"sort": "colour"}).status_code == 422


def test_the_page_after_a_deleted_model_goes_on(app: ServedApp, several: dict[str, str]) -> None:
    page = app.http.get("/v1/models", params={"sort": "name", "limit": 2}).json()
    app.http.delete(f"/v1/jobs/{several['b']}")
    after = app.http.get("/v1/models", params={"sort": "name", "limit": 2, "cursor": page["cursor"]}).json()
    assert [model["id"] for model in after["models"]] == [several["c"], several[""]]


def test_a_long_list_is_not_sorted(
    app: ServedApp, several: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ranking, "SORTED", 3)
    for noun in ("models", "jobs"):
        problem(app.http.get(f"/v1/{noun}", params={"sort": "size"}), 422, "list_too_long")
        assert len(app.http.get(f"/v1/{noun}").json()[noun]) == 4
