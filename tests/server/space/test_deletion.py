"""Deletions and new jobs that meet: one of the two always sees the other, and a deletion that is cut off is finished.

Every meeting is brought about at the critical point, by stopping one side there; nothing is left to chance.
"""

from collections.abc import Callable
from typing import Any

import pytest

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import StorageError
from splatmill.schema import CreateJob, TrainOptions
from splatmill_server import admission
from splatmill_server.access.caller import Caller
from splatmill_server.base.problems import ProblemError
from splatmill_server.jobs.records import Jobs
from splatmill_server.space import deletion as deletion_module
from splatmill_server.space import job_uses
from tests.support.served_app import Serve, ServedApp, problem, stored

pytestmark = pytest.mark.slow  # a server for each case


def once(call: Callable[[], None]) -> Callable[[], None]:
    """Return a function that calls `call` the first time."""
    left = [call]

    def run() -> None:
        if left:
            left.pop()()

    return run


def code_of(call: Callable[[], object]) -> str:
    with pytest.raises(ProblemError) as caught:
        call()
    return caught.value.problem.code


def ended(app: ServedApp, **options: Any) -> str:
    """A job that has ended, with its model."""
    job_id = app.job(**options)
    app.begin(job_id)
    app.finish(job_id)
    return job_id


def test_a_job_that_is_inserted_before_the_mark_is_seen_by_the_deletion(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = app.capture()
    mark, jobs = deletion_module._Mark.set, []

    def late(self: deletion_module._Mark) -> None:
        jobs.append(app.job(capture))  # the deletion has begun, and its mark is not set
        mark(self)

    monkeypatch.setattr(deletion_module._Mark, "set", late)
    assert code_of(lambda: app.service.deletion.capture(capture)) == "capture_in_use"
    assert app.state(jobs[0]) == "queued"
    assert app.http.get(f"/v1/captures/{capture}").json()["files"]
    assert app.job(capture)  # the mark is gone


def test_a_job_is_not_inserted_once_a_deletion_has_begun(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = app.capture()
    look = job_uses.unfinished_jobs
    codes: list[str] = []

    def meet() -> None:
        answer = app.http.post("/v1/jobs", json={"capture": capture})
        codes.append(answer.json()["code"])

    meeting = once(meet)

    def looked(connection: object) -> object:
        jobs = look(connection)  # type: ignore[arg-type]  # a connection
        meeting()  # after the deletion has looked, and before it deletes
        return jobs

    monkeypatch.setattr("splatmill_server.space.deletion.unfinished_jobs", looked)
    app.service.deletion.capture(capture)
    assert codes == ["capture_not_found"]
    assert app.redis.zcard(keys.JOBS) == 0
    assert not any(path.startswith("captures/") for path in stored(app))


def test_a_deletion_between_the_checks_of_a_request_and_its_job_keeps_the_job_out(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = app.capture()
    create = Jobs.create

    def late(self: Jobs, *arguments: object, **more: object) -> object:
        app.service.deletion.capture(capture)  # everything was checked, and nothing is inserted
        return create(self, *arguments, **more)  # type: ignore[arg-type]  # passed on

    monkeypatch.setattr(Jobs, "create", late)
    problem(app.http.post("/v1/jobs", json={"capture": capture}), 404, "capture_not_found")
    assert app.redis.zcard(keys.JOBS) == 0
    assert app.redis.scard(keys.ACTIVE) == 0


def test_a_mark_that_is_set_while_the_job_is_inserted_makes_the_insertion_look_again(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = app.capture()
    check = admission.check_marks
    looks = []

    def checked(*arguments: object) -> None:
        check(*arguments)  # type: ignore[arg-type]  # passed on
        looks.append(1)
        if len(looks) == 1:
            app.redis.set(keys.deleting(f"capture/{capture}"), "deleting")

    monkeypatch.setattr("splatmill_server.admission.check_marks", checked)
    request = CreateJob(capture=capture)
    assert code_of(lambda: app.service.admission.create(Caller("ann"), request)) == "capture_not_found"
    assert looks == [1]
    assert app.redis.zcard(keys.JOBS) == 0


def test_a_restart_and_a_deletion_of_the_same_job_do_not_both_happen(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = ended(app)
    look = job_uses.unfinished_jobs
    answers = []
    meeting = once(lambda: answers.append(app.http.post(f"/v1/jobs/{job_id}/restart")))

    def looked(connection: object) -> object:
        meeting()
        return look(connection)  # type: ignore[arg-type]  # a connection

    monkeypatch.setattr("splatmill_server.space.deletion.unfinished_jobs", looked)
    app.service.deletion.job(job_id)
    problem(answers[0], 404, "job_not_found")
    assert stored_of(app, job_id) == []
    assert app.redis.smembers(keys.ACTIVE) == set()


def stored_of(app: ServedApp, job_id: str) -> list[str]:
    return [path for path in stored(app) if job_id in path]


def test_a_restarted_job_is_active_in_the_same_step(app: ServedApp, monkeypatch: pytest.MonkeyPatch) -> None:
    job_id = ended(app)
    assert app.service.jobs.list_active() == []
    check = admission.check_marks

    def checked(*arguments: object) -> None:
        check(*arguments)  # type: ignore[arg-type]  # passed on
        app.service.jobs.list_active()  # the reaper retires ended jobs at any moment

    monkeypatch.setattr("splatmill_server.admission.check_marks", checked)
    assert app.http.post(f"/v1/jobs/{job_id}/restart").status_code == 202
    assert app.redis.smembers(keys.ACTIVE) == {job_id.encode()}


def test_a_model_that_an_unfinished_job_starts_from_stays(app: ServedApp) -> None:
    model = ended(app)
    job_id = app.job(start=model)
    refused = problem(app.http.delete(f"/v1/jobs/{model}"), 409, "model_in_use")
    assert refused["facts"] == {"job": job_id}
    assert app.http.get(f"/v1/models/{model}").status_code == 200
    app.http.post(f"/v1/jobs/{job_id}/cancel")
    app.service.reaper.tick()
    assert app.http.delete(f"/v1/jobs/{model}").status_code == 204
    assert stored_of(app, model) == []
    request = CreateJob(capture=app.capture(), options=TrainOptions(start=model))
    assert code_of(lambda: app.service.admission.create(Caller("ann"), request)) == "model_not_found"


def test_a_capture_that_is_made_again_under_its_key_can_be_trained(app: ServedApp) -> None:
    made = app.http.post("/v1/captures", json={"key": "garden"}).json()["id"]
    assert app.http.delete(f"/v1/captures/{made}").status_code == 204
    again = app.http.post("/v1/captures", json={"key": "garden"}).json()["id"]
    assert again == made
    for name in ("a.jpg", "b.jpg"):
        app.http.put(f"/v1/captures/{again}/images/{name}", content=name.encode())
    assert app.http.post("/v1/jobs", json={"capture": again}).status_code == 202


@pytest.mark.parametrize("files_left", [1, 3])
def test_a_deletion_that_is_cut_off_is_finished_by_the_next_sweep(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch, files_left: int
) -> None:
    capture, model = app.capture("a.jpg", "b.jpg", "c.jpg"), ended(app)
    delete, left = app.service.storage._delete, [0]

    def dying(paths: list[str]) -> int:
        for path in paths:
            left[0] += 1
            if left[0] > files_left:
                raise StorageError("the process was killed here")
            delete([path])
        return len(paths)

    for target in (app.service.deletion.capture, app.service.deletion.job):
        left[0] = 0
        monkeypatch.setattr(app.service.storage, "_delete", dying)
        with pytest.raises(StorageError):
            target(capture if target == app.service.deletion.capture else model)
        monkeypatch.setattr(app.service.storage, "_delete", delete)
    assert any(capture in path for path in stored(app))
    assert app.service.deletion.finish() == []  # another process may still be at it
    app.redis.delete(keys.deleting(f"capture/{capture}"), keys.deleting(f"model/{model}"))
    assert sorted(app.service.deletion.finish()) == sorted([f"capture/{capture}", f"model/{model}"])
    assert not any(capture in path or model in path for path in stored(app))
    assert app.redis.hgetall(keys.DELETIONS) == {}
    assert app.redis.exists(*keys.of_job(model)) == 0
    assert app.service.deletion.finish() == []


def test_a_deletion_that_was_cut_off_does_not_reach_what_is_used_since(app: ServedApp) -> None:
    job_id = app.job(capture := app.capture())
    app.redis.hset(keys.DELETIONS, mapping={f"capture/{capture}": "begun", f"model/{job_id}": "begun"})
    assert app.service.deletion.finish() == []
    assert app.state(job_id) == "queued"
    assert app.http.get(f"/v1/captures/{capture}").json()["files"]
    assert app.redis.hgetall(keys.DELETIONS) == {}


def test_deleting_a_capture_keeps_the_models_made_of_it(serve: Serve) -> None:
    app = serve()
    capture = app.capture()
    model = ended(app, capture_id=capture)
    assert app.http.delete(f"/v1/captures/{capture}").status_code == 204
    assert app.http.get(f"/v1/models/{model}").status_code == 200
    assert layout.job_record(model) in stored(app)
