"""Jobs over real HTTP: creating, repeating, listing, restarting, deleting, and every refusal with its code.

Not proved here: that a worker trains (tests/service), and cancelling a running process (test_cancel).
"""

import hashlib
import json
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from splatmill.backplane import keys
from splatmill.backplane.jobs import row
from splatmill.backplane.queue import queue
from splatmill.backplane.storage import layout
from splatmill.schema import JobState, PlanEvent, Problem, ProgressEvent, StateEvent, storable_name
from splatmill_server.base import lists
from tests.support.served_app import ServedApp, problem, raw, stored

PHOTO = b"\xff\xd8\xff a photo"


def test_a_job_is_accepted_queued_and_seen(app: ServedApp) -> None:
    capture_id = app.capture()
    made = app.http.post("/v1/jobs", json={"capture": capture_id, "name": "fox", "options": {"steps": 100}})
    assert made.status_code == 202
    job = made.json()
    assert made.headers["location"] == f"/v1/jobs/{job['id']}"
    assert (job["state"], job["capture"], job["name"], job["options"]["steps"]) == (
        "queued",
        capture_id,
        "fox",
        100,
    )
    assert app.http.get(made.headers["location"]).json() == job
    assert queue.status(app.redis, job["id"], 1).state == "waiting"
    assert (job["queue_position"], job["waiting_for"], job["priority"]) == (0, "any", 0)


def test_what_a_worker_says_is_what_a_client_sees(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.say(
        job_id,
        StateEvent(state=JobState.training),
        ProgressEvent(stage="training", done=7, total=9, psnr=20.5),
    )
    job = app.http.get(f"/v1/jobs/{job_id}").json()
    assert (job["state"], job["attempt"], job["progress"]["psnr"]) == ("training", 1, 20.5)
    app.finish(job_id)
    job = app.http.get(f"/v1/jobs/{job_id}").json()
    assert (job["state"], job["model"], job["links"]["model"]) == (
        "succeeded",
        job_id,
        f"/v1/models/{job_id}",
    )


def test_one_idempotency_key_makes_one_job(app: ServedApp) -> None:
    body: dict[str, Any] = {"capture": app.capture(), "options": {"steps": 5}}
    key = {"Idempotency-Key": "once"}
    first = app.http.post("/v1/jobs", json=body, headers=key)
    again = app.http.post("/v1/jobs", json=body, headers=key)
    assert (first.status_code, again.status_code) == (202, 202)
    assert first.json()["id"] == again.json()["id"]
    assert again.headers["idempotency-replayed"] == "true"
    # What is left out means the default: the same request, said differently.
    said = body | {"options": {"steps": 5, "holdout": 8}}
    assert app.http.post("/v1/jobs", json=said, headers=key).json()["id"] == first.json()["id"]
    other = body | {"options": {"steps": 6}}
    refused = problem(app.http.post("/v1/jobs", json=other, headers=key), 409, "idempotency_conflict")
    assert refused["facts"]["job"] == first.json()["id"]
    assert len(app.http.get("/v1/jobs").json()["jobs"]) == 1


def test_many_requests_at_once_with_one_key_make_one_job(app: ServedApp) -> None:
    files = [("images", (f"{i}.jpg", PHOTO + b"%d" % i)) for i in range(3)]
    gate = threading.Barrier(6)

    def post(_: int) -> str:
        gate.wait()
        answer = app.http.post("/v1/jobs", files=files, headers={"Idempotency-Key": "one"})
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    with ThreadPoolExecutor(6) as pool:
        made = set(pool.map(post, range(6)))
    assert len(made) == 1
    assert [job["id"] for job in app.http.get("/v1/jobs").json()["jobs"]] == list(made)
    captures = app.http.get("/v1/captures").json()["captures"]
    job = app.http.get(f"/v1/jobs/{made.pop()}").json()
    assert [capture["id"] for capture in captures] == [job["capture"]]
    stored = json.loads(app.service.storage.get(layout.unfinished_job(job["id"])))
    assert stored["capture"] == job["capture"], "a Redis that is lost from here on is filled with it"


@pytest.mark.parametrize(
    ("options", "code", "says"),
    [
        ({"stepz": 3}, "unknown_option", "'steps'"),
        ({"steps": 0}, "option_out_of_range", "steps"),
        ({"image_size": 100_000}, "option_out_of_range", "8192"),
        ({"preset": "splendid"}, "option_out_of_range", "draft"),
        ({"steps": "many"}, "invalid_request", "steps"),
        ([], "invalid_request", "options"),
    ],
)
def test_options_that_do_not_exist_or_fit_are_named(
    app: ServedApp, options: Any, code: str, says: str
) -> None:
    capture_id = app.capture()
    refused = problem(app.http.post("/v1/jobs", json={"capture": capture_id, "options": options}), 422, code)
    assert says in refused["detail"] + (refused.get("advice") or "") + json.dumps(refused["facts"])
    assert app.http.get("/v1/jobs").json()["jobs"] == []
    assert app.job(capture_id)


def test_captures_that_cannot_become_a_scene_are_refused(app: ServedApp) -> None:
    empty = app.http.post("/v1/captures", json={}).json()["id"]
    problem(app.http.post("/v1/jobs", json={"capture": empty}), 422, "no_images")
    single = app.capture("only.jpg")
    refused = problem(app.http.post("/v1/jobs", json={"capture": single}), 422, "too_few_images")
    assert refused["advice"]
    app.http.put(f"/v1/captures/{single}/poses/transforms.json", content=b"{}")
    assert app.job(single)  # a single view with its pose is the worker's to judge
    assert app.job(app.capture("video.mp4"))
    problem(app.http.post("/v1/jobs", json={"capture": "0123456789abcdef"}), 404, "capture_not_found")
    problem(app.http.post("/v1/jobs", json={"capture": "../../etc"}), 404, "capture_not_found")


def test_bodies_that_are_no_json_object_are_refused(app: ServedApp) -> None:
    def post(content: bytes, media_type: str) -> Any:
        return app.http.post("/v1/jobs", content=content, headers={"Content-Type": media_type})

    problem(post(b'{"capture": ', "application/json"), 400, "malformed_body")
    problem(post(b"\xff\xfe\x00", "application/json"), 400, "malformed_body")
    problem(post(b"[]", "application/json"), 422, "invalid_request")
    problem(post(b"capture=1", "application/x-www-form-urlencoded"), 415, "unsupported_media_type")
    problem(post(b"x", "text/plain"), 415, "unsupported_media_type")
    problem(post(b" " * 2_000_000, "application/json"), 413, "body_too_large")
    problem(app.http.post("/v1/jobs", content=iter([b" " * 600_000] * 2)), 415, "unsupported_media_type")


def test_pages_of_jobs_hold_each_once_newest_first(app: ServedApp) -> None:
    capture_id = app.capture()
    made = [app.job(capture_id) for _ in range(7)]
    for job_id in made[::2]:
        app.begin(job_id)
    assert pages(app, limit=3) == sorted(made, key=lambda i: created(app, i), reverse=True)
    assert pages(app, limit=2, state="preparing") == [i for i in pages(app, limit=50) if i in made[::2]]
    problem(app.http.get("/v1/jobs?cursor=bm9uc2Vuc2U"), 422, "cursor_invalid")
    problem(app.http.get("/v1/jobs?limit=0"), 422, "invalid_request")


def created(app: ServedApp, job_id: str) -> tuple[int, str]:
    job_row = row.read(app.redis, job_id)
    assert job_row is not None
    return int(job_row.created_at.timestamp() * 1000), job_id


def pages(app: ServedApp, **params: Any) -> list[str]:
    ids: list[str] = []
    while True:
        page = app.http.get("/v1/jobs", params=params).json()
        ids += [job["id"] for job in page["jobs"]]
        if page["cursor"] is None:
            return ids
        params["cursor"] = page["cursor"]


def test_a_list_by_state_holds_each_job_that_is_in_the_state_and_no_other(app: ServedApp) -> None:
    capture_id = app.capture()
    jobs = [app.job(capture_id) for _ in range(7)]
    waits, runs, again, ended, late, restarted, cancelled = jobs
    for job_id in (runs, again, ended, late, restarted):
        app.begin(job_id)
        app.say(job_id, PlanEvent(plan={"text": '"state":"failed"'}), StateEvent(state=JobState.training))
    app.say(again, StateEvent(state=JobState.queued))
    app.say(late, StateEvent(state=JobState.succeeded), StateEvent(state=JobState.queued))
    for job_id in (ended, restarted):
        app.say(job_id, StateEvent(state=JobState.failed, problem=Problem.of("diverged", "It diverged.")))
    app.http.post(f"/v1/jobs/{restarted}/restart").raise_for_status()
    app.http.post(f"/v1/jobs/{cancelled}/cancel").raise_for_status()
    app.service.reaper.tick()
    states = {job_id: app.state(job_id) for job_id in jobs}
    assert states == {
        waits: "queued",
        runs: "training",
        again: "queued",
        ended: "failed",
        late: "succeeded",
        restarted: "queued",
        cancelled: "cancelled",
    }
    for state in JobState:
        listed = {job_id for job_id, current in states.items() if current == state.value}
        assert set(pages(app, limit=1, state=state.value)) == listed, state


def test_a_page_of_a_narrowed_list_looks_at_a_limited_number_of_jobs(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lists, "SCANNED", 3)
    monkeypatch.setattr(lists, "BATCH", 2)
    capture_id = app.capture()
    made = [app.job(capture_id) for _ in range(9)]
    oldest = sorted(made, key=lambda i: created(app, i))[0]
    app.begin(oldest)
    assert pages(app, limit=1, state="preparing") == [oldest]
    assert len(pages(app, limit=2, state="queued")) == 8
    page = app.http.get("/v1/jobs", params={"state": "preparing", "limit": 1}).json()
    assert page["jobs"] == []
    assert page["cursor"] is not None, "only some of the jobs were looked at"


def test_a_running_job_can_be_neither_deleted_nor_restarted(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    problem(app.http.delete(f"/v1/jobs/{job_id}"), 409, "job_running")
    problem(app.http.post(f"/v1/jobs/{job_id}/restart"), 409, "job_running")
    app.finish(job_id)
    problem(app.http.post(f"/v1/jobs/{job_id}/cancel"), 409, "job_finished")
    assert app.state(job_id) == "succeeded"


def test_a_failed_job_says_why_and_restarts_as_a_new_generation(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    why = Problem.of(
        "sfm_too_few_registered", "Registered 2 of 9 images.", advice="Take more.", facts={"n": 2}
    )
    app.say(job_id, StateEvent(state=JobState.failed, problem=why))
    job = app.http.get(f"/v1/jobs/{job_id}").json()
    assert job["state"] == "failed"
    assert job["problem"]["code"] == "sfm_too_few_registered"
    assert job["problem"]["facts"] == {"n": 2}
    again = app.http.post(f"/v1/jobs/{job_id}/restart")
    assert again.status_code == 202
    assert (again.json()["state"], again.json().get("problem")) == ("queued", None)
    assert app.http.post(f"/v1/jobs/{job_id}/restart").status_code == 202  # wishing twice is wishing once
    job_row = row.read(app.redis, job_id)
    assert job_row is not None
    assert job_row.generation == 2
    assert queue.status(app.redis, job_id, 2).state == "waiting"


def test_deleting_a_job_removes_its_model_and_every_key(app: ServedApp) -> None:
    capture_id = app.capture()
    before = stored(app)
    job_id = app.job(capture_id)
    app.begin(job_id)
    app.service.storage.put(layout.job_work(job_id) + "/checkpoints/1", b"x")
    app.finish(job_id)
    assert app.http.delete(f"/v1/jobs/{job_id}").status_code == 204
    assert stored(app) == before
    mark = keys.deleting(f"model/{job_id}")  # keeps jobs from starting from the model
    assert [key for key in app.redis.keys("*") if job_id.encode() in key] == [mark.encode()]
    assert app.redis.ttl(mark) > 0  # it expires
    problem(app.http.get(f"/v1/jobs/{job_id}"), 404, "job_not_found")
    problem(app.http.delete(f"/v1/jobs/{job_id}"), 404, "job_not_found")


@pytest.mark.slow
def test_one_request_with_a_form_does_it_all(app: ServedApp) -> None:
    files = [("images", (f"{i:04}.jpg", PHOTO + b"%d" % i)) for i in range(300)]
    files += [("masks", ("0000.png", PHOTO)), ("poses", ("transforms.json", b"{}"))]
    form = {"options": '{"steps": 7}', "name": "fox"}
    made = app.http.post("/v1/jobs", files=files, data=form, headers={"Idempotency-Key": "form"})
    assert made.status_code == 202, made.text
    assert (made.json()["options"]["steps"], made.json()["name"]) == (7, "fox")
    held = app.http.get(f"/v1/captures/{made.json()['capture']}").json()["files"]
    assert {role: sum(f["role"] == role for f in held) for role in ("images", "masks", "poses")} == {
        "images": 300,
        "masks": 1,
        "poses": 1,
    }
    again = app.http.post("/v1/jobs", files=files, data=form, headers={"Idempotency-Key": "form"})
    assert again.json()["id"] == made.json()["id"]
    assert len(app.http.get("/v1/captures").json()["captures"]) == 1


def test_one_bad_name_in_a_form_is_changed_and_named_in_the_log(app: ServedApp) -> None:
    names = ["a.jpg", "x:1.jpg", " lead.jpg"]
    files = [("images", (name, PHOTO + name.encode())) for name in names]
    job = app.http.post("/v1/jobs", files=files).json()
    held = {
        entry["name"]: entry["sha256"]
        for entry in app.http.get(f"/v1/captures/{job['capture']}").json()["files"]
    }
    assert held == {storable_name(name): hashlib.sha256(PHOTO + name.encode()).hexdigest() for name in names}
    lines = app.http.get(f"/v1/jobs/{job['id']}/logs").json()["lines"]
    assert [(line["level"], line["message"]) for line in lines] == [
        ("warning", f"The file name {name!r} is not accepted; the file is stored as {storable_name(name)}.")
        for name in names[1:]
    ]
    assert app.state(job["id"]) == "queued"


def test_a_form_that_is_refused_leaves_nothing(app: ServedApp) -> None:
    def post(files: Any, **data: str) -> Any:
        return app.http.post("/v1/jobs", files=files, data=data)

    two = [("images", ("a.jpg", PHOTO)), ("images", ("b.jpg", PHOTO + b"2"))]
    problem(post([*two, ("images", ("../c.jpg", PHOTO))]), 422, "name_invalid")
    problem(post([*two, ("images", ("a.jpg", b"other"))]), 409, "name_taken")
    problem(post([*two, ("images", ("c.jpg", b""))]), 422, "file_empty")
    problem(post([*two, ("pictures", ("c.jpg", PHOTO))]), 422, "invalid_request")
    problem(post(two, options="{"), 400, "malformed_body")
    problem(post(two, options='{"stepz": 1}'), 422, "unknown_option")
    problem(post(two[:1]), 422, "too_few_images")
    cut = b'--x\r\nContent-Disposition: form-data; name="images"; filename="a.jpg"\r\n\r\n' + PHOTO
    status, body = raw(app, "POST /v1/jobs HTTP/1.1", cut, "Content-Type: multipart/form-data; boundary=x")
    assert status == 400
    assert b"body_cut_off" in body
    status, body = raw(app, "POST /v1/jobs HTTP/1.1", cut, "Content-Type: multipart/form-data")
    assert (status, b"malformed_body" in body) == (400, True)
    assert stored(app) == []
    assert app.http.get("/v1/jobs").json()["jobs"] == []


def test_a_job_starts_only_from_a_model_that_is_there(app: ServedApp) -> None:
    capture_id = app.capture()
    body: dict[str, Any] = {"capture": capture_id, "options": {"start": "before.ply"}}
    refused = problem(app.http.post("/v1/jobs", json=body), 404, "file_not_found")
    assert "before.ply" in refused["detail"]
    app.http.put(f"/v1/captures/{capture_id}/poses/before.ply", content=b"ply").raise_for_status()
    assert app.http.post("/v1/jobs", json=body).json()["options"]["start"] == "before.ply"

    body["options"]["start"] = "0123456789abcdef"
    problem(app.http.post("/v1/jobs", json=body), 404, "model_not_found")
    unfinished = app.job(capture_id)
    body["options"]["start"] = unfinished
    problem(app.http.post("/v1/jobs", json=body), 409, "model_not_ready")
    app.begin(unfinished)
    app.finish(unfinished)
    assert app.http.post("/v1/jobs", json=body).status_code == 202
    for nonsense in ("../model.ply", "model.obj", ""):
        body["options"]["start"] = nonsense
        assert app.http.post("/v1/jobs", json=body).status_code == 422


def test_a_model_among_the_poses_gives_a_single_photo_no_camera(app: ServedApp) -> None:
    capture_id = app.capture("only.jpg")
    app.http.put(f"/v1/captures/{capture_id}/poses/m.ply", content=b"ply").raise_for_status()
    answer = app.http.post("/v1/jobs", json={"capture": capture_id, "options": {"start": "m.ply"}})
    problem(answer, 422, "too_few_images")
