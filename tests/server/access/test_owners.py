"""Records of one owner are absent for another: ids answer 404, lists leave them out, idempotency keys are apart.

Not proved here: how a caller is found from a key (test_keys).
"""

import hashlib
import json
from typing import Any

import httpx
import pytest
from starlette.datastructures import Headers

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.schema import Scope
from splatmill_server.access import caller
from tests.support.served_app import Serve, ServedApp, problem

pytestmark = pytest.mark.slow  # a server for each case


async def _caller(asked: object, headers: Headers) -> caller.Caller:
    owner = headers.get("x-owner", "default")
    scopes = set(Scope) if owner in ("default", "chief") else {Scope.read, Scope.train}
    return caller.Caller(owner, scopes=frozenset(scopes))


@pytest.fixture
def app(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> ServedApp:
    """An app whose callers say who they are in the header X-Owner; `chief` and `default` are admins."""
    served = serve()
    monkeypatch.setattr(served.service.authentication, "caller", _caller)
    return served


class Person:
    """Requests of one owner."""

    def __init__(self, app: ServedApp, owner: str) -> None:
        self.http = app.http
        self.headers = {"X-Owner": owner}

    def __call__(self, method: str, path: str, headers: Any = None, **more: Any) -> httpx.Response:
        return self.http.request(method, path, headers=self.headers | (headers or {}), **more)

    def capture(self) -> str:
        made = self("POST", "/v1/captures", json={}).json()
        for name in ("a.jpg", "b.jpg"):
            path = f"/v1/captures/{made['id']}/images/{name}"
            assert self("PUT", path, content=name.encode()).status_code == 201
        return str(made["id"])

    def job(self, capture: str, options: Any = None, **more: Any) -> httpx.Response:
        return self("POST", "/v1/jobs", json={"capture": capture, "options": options or {}}, **more)

    def listed(self, kind: str, query: str = "") -> list[str]:
        return [record["id"] for record in self("GET", f"/v1/{kind}{query}").json()[kind]]


@pytest.fixture
def ann(app: ServedApp) -> Person:
    return Person(app, "ann")


@pytest.fixture
def bob(app: ServedApp) -> Person:
    return Person(app, "bob")


def finished(app: ServedApp, job_id: str, owner: str) -> None:
    """End a job as a worker does, which copies the owner from the row into job.json."""
    app.begin(job_id)
    app.finish(job_id)
    record = json.loads(app.service.storage.get(layout.job_record(job_id)))
    app.service.storage.put(layout.job_record(job_id), json.dumps(record | {"owner": owner}).encode())


def test_every_record_names_its_owner_and_is_listed_for_it_alone(
    app: ServedApp, ann: Person, bob: Person
) -> None:
    capture = ann.capture()
    job = ann.job(capture).json()
    finished(app, job["id"], "ann")
    assert job["owner"] == "ann"
    for kind, record_id in (("captures", capture), ("jobs", job["id"]), ("models", job["id"])):
        assert ann("GET", f"/v1/{kind}/{record_id}").json()["owner"] == "ann"
        assert ann.listed(kind) == [record_id]
        assert bob.listed(kind) == []
        assert bob.listed(kind, "?owner=ann") == []
        problem(bob("GET", f"/v1/{kind}/{record_id}"), 404, f"{kind[:-1]}_not_found")


def test_an_admin_sees_all_owners_and_may_choose_one(app: ServedApp, ann: Person, bob: Person) -> None:
    chief = Person(app, "chief")
    mine, yours = ann.capture(), bob.capture()
    jobs = [ann.job(mine).json()["id"], bob.job(yours).json()["id"]]
    assert sorted(chief.listed("captures")) == sorted([mine, yours])
    assert sorted(chief.listed("jobs")) == sorted(jobs)
    assert chief.listed("captures", "?owner=bob") == [yours]
    assert chief.listed("jobs", "?owner=bob") == jobs[1:]
    assert chief("GET", f"/v1/jobs/{jobs[0]}").status_code == 200
    assert chief.job(mine).json()["owner"] == "chief"


def test_pages_of_one_owner_skip_the_others_and_end(app: ServedApp, ann: Person, bob: Person) -> None:
    mine, yours = ann.capture(), bob.capture()
    jobs = []
    for _ in range(3):
        jobs.append(ann.job(mine).json()["id"])
        for _ in range(4):
            bob.job(yours)
    ids, cursor = [], ""
    while cursor is not None:
        page = ann("GET", f"/v1/jobs?limit=1{cursor and '&cursor=' + cursor}").json()
        ids += [job["id"] for job in page["jobs"]]
        cursor = page["cursor"]
    assert sorted(ids) == sorted(jobs)
    assert len(ids) == 3


def test_a_job_uses_only_what_its_owner_may_see(app: ServedApp, ann: Person, bob: Person) -> None:
    mine, yours = ann.capture(), bob.capture()
    model = ann.job(mine).json()["id"]
    problem(bob.job(mine), 404, "capture_not_found")
    problem(bob.job(yours, {"start": model}), 404, "model_not_found")
    finished(app, model, "ann")
    problem(bob.job(yours, {"start": model}), 404, "model_not_found")
    form = {"files": [("images", (f"{n}.jpg", b"photo %d" % n)) for n in range(2)]}
    problem(
        bob("POST", "/v1/jobs", data={"options": f'{{"start": "{model}"}}'}, **form), 404, "model_not_found"
    )
    assert bob.listed("captures") == [yours]
    made = bob("POST", "/v1/jobs", **form).json()
    assert made["owner"] == "bob"
    assert bob("GET", f"/v1/captures/{made['capture']}").json()["owner"] == "bob"
    assert ann.job(mine, {"start": model}).status_code == 202


def test_idempotency_keys_of_two_owners_are_apart(app: ServedApp, ann: Person, bob: Person) -> None:
    mine, yours = ann.capture(), bob.capture()
    key = {"Idempotency-Key": "once"}
    first, second = ann.job(mine, headers=key).json()["id"], bob.job(yours, headers=key).json()["id"]
    assert first != second
    assert ann.job(mine, headers=key).json()["id"] == first
    # The key of an owner that existed before owners did has the digest of the key alone.
    old = Person(app, "default").job(app.capture(), headers=key).json()["id"]
    assert len({first, second, old}) == 3
    assert app.redis.exists(keys.idempotency(hashlib.sha256(b"once").hexdigest()))


def test_keys_of_captures_of_two_owners_are_apart(app: ServedApp, ann: Person, bob: Person) -> None:
    ids = [person("POST", "/v1/captures", json={"key": "same"}).json()["id"] for person in (ann, bob, ann)]
    assert ids[0] == ids[2] != ids[1]


def test_an_upload_or_import_of_another_owner_is_absent(app: ServedApp, ann: Person, bob: Person) -> None:
    capture = ann.capture()
    headers = {"Upload-Complete": "?0", "Upload-Length": "4"}
    begun = ann("PUT", f"/v1/captures/{capture}/images/c.mp4", headers=headers)
    upload = begun.headers["location"]
    assert ann("HEAD", upload).status_code == 204
    assert bob("HEAD", upload).status_code == 404
    problem(bob("DELETE", upload), 404, "capture_not_found")
    headers = {"Upload-Offset": "0", "Upload-Complete": "?1", "Content-Type": "application/partial-upload"}
    problem(bob("PATCH", upload, headers=headers, content=b"mine"), 404, "capture_not_found")
    problem(bob("GET", f"/v1/captures/{capture}/imports"), 404, "capture_not_found")
    url = {"url": "https://example.org/a.jpg"}
    problem(bob("POST", f"/v1/captures/{capture}/import", json=url), 404, "capture_not_found")
    assert ann("PATCH", upload, headers=headers, content=b"mine").status_code == 201


def test_records_without_an_owner_belong_to_the_default_owner(
    app: ServedApp, ann: Person, bob: Person
) -> None:
    capture = app.capture()
    job_id = app.job(capture)
    app.redis.hdel(keys.job(job_id), "owner")
    for person, status in ((ann, 404), (bob, 404), (Person(app, "default"), 200)):
        assert person("GET", f"/v1/jobs/{job_id}").status_code == status
    assert app.http.get(f"/v1/jobs/{job_id}").json()["owner"] == "default"
