"""Every endpoint of the OpenAPI document, walked: what another owner, a read-only key and nobody get.

An endpoint with a path parameter that this test does not know fails it: say in `world` what fills the parameter. Not
proved here: what the endpoints do for those who may (the tests of each noun).
"""

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from splatmill.backplane.storage import layout
from splatmill.schema import Scope
from splatmill_server.app import create_app
from splatmill_server.base.settings import Settings
from tests.support.served_app import Serve, ServedApp, problem

OPEN = {"/healthz", "/readyz", "/openapi.json", "/docs"}
LINKS = "/s/{token}/"
"""What is below it asks for the token in the address and for nothing else (test_shares.py)."""
SAFE = {"get", "head", "options"}
READS = {
    "/v1/jobs/{job_id}/watch",
    "/v1/models/{model_id}/render",
    "/v1/models/{model_id}/orbit",
    "/v1/session",
    "/v1/estimate",
    "/v1/camera-paths",
}
"""Addresses whose POST and DELETE change no record."""

OWN = {"capture_id", "job_id", "model_id", "webhook_id"}
"""Path parameters that name a record of an owner."""

pytestmark = pytest.mark.slow


@dataclass
class World:
    """A server with records of ann, and keys: `bob` may train, `reader` may read ann's records, `root` is an admin."""

    app: ServedApp
    ids: dict[str, str]
    secrets: dict[str, str]

    def ask(self, who: str, method: str, template: str) -> Any:
        path = template.replace("{name}", "a.jpg").replace("{role}", "images").replace("{format}", "ply")
        for name, value in self.ids.items():
            path = path.replace(f"{{{name}}}", value)
        assert "{" not in path, f"tell this test what fills the parameter of {template}"
        secret = self.secrets.get(who)
        headers = {"Authorization": f"Bearer {secret}" if secret else "none"}
        with self.app.http.stream(method, path, headers=headers) as answer:
            if not answer.headers.get("content-type", "").startswith("text/event-stream"):
                answer.read()  # a stream of events has no end before its job has
        return answer


@pytest.fixture
def operations() -> list[tuple[str, str, dict[str, Any]]]:
    with tempfile.TemporaryDirectory() as folder:
        document = create_app(Settings(data=Path(folder))).openapi()
    all_operations = [
        (method, path, operation)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]
    assert len(all_operations) > 25
    assert [path for _, path, _ in all_operations if path.startswith(LINKS)]
    return [
        (method, path, operation) for method, path, operation in all_operations if not path.startswith(LINKS)
    ]


@pytest.fixture
def world(serve: Serve) -> World:
    app = serve(api_key="s3cret")

    def key(owner: str, *scopes: str) -> dict[str, Any]:
        answer = app.http.post("/v1/keys", json={"name": owner, "owner": owner, "scopes": scopes})
        return dict(answer.json())

    ann = key("ann", "train")
    secrets = {
        "ann": ann["secret"],
        "bob": key("bob", "train")["secret"],
        "reader": key("ann", "read")["secret"],
        "root": "s3cret",
    }
    app.http.headers["Authorization"] = f"Bearer {secrets['ann']}"
    capture = app.capture()
    done, waiting = app.job(capture), app.job(capture)
    app.begin(done)
    app.finish(done)
    record = json.loads(app.service.storage.get(layout.job_record(done)))
    app.service.storage.put(layout.job_record(done), json.dumps(record | {"owner": "ann"}).encode())
    begun = app.http.put(
        f"/v1/captures/{capture}/images/c.jpg", content=b"c", headers={"Upload-Complete": "?0"}
    )
    ids = {"capture_id": capture, "job_id": waiting, "model_id": done, "key_id": ann["id"]}
    ids["share_id"] = "fedcba98"  # guarded by its model
    ids["orbit_id"] = "0" * 16  # guarded by its model
    ids["mesh_id"] = "0" * 16  # guarded by its model
    ids["import_id"] = "0" * 16  # guarded by its capture
    ids["webhook_id"] = app.http.post("/v1/webhooks", json={"url": "http://8.8.8.8/"}).json()["id"]
    ids["delivery_id"] = "0" * 16  # guarded by its webhook
    ids["upload_id"] = begun.headers["location"].rsplit("/", 1)[-1]
    return World(app, ids, secrets)


def test_nobody_gets_in(world: World, operations: list[tuple[str, str, dict[str, Any]]]) -> None:
    for method, path, _ in operations:
        answer = world.ask("nobody", method, path)
        assert answer.status_code == (200 if path in OPEN else 401), (method, path)


def test_another_owner_learns_nothing(
    world: World, operations: list[tuple[str, str, dict[str, Any]]]
) -> None:
    tried = 0
    for method, path, operation in operations:
        names = {
            parameter["name"] for parameter in operation.get("parameters", []) if parameter["in"] == "path"
        }
        answer = world.ask("bob", method, path)
        if names & OWN and method == "head":
            assert answer.status_code == 404, path
        elif names & OWN:
            refusal = problem(answer, 404, answer.json()["code"])
            assert refusal["code"] in {f"{name.removesuffix('_id')}_not_found" for name in names & OWN}, path
            tried += 1
        elif answer.status_code == 403:
            needed = problem(answer, 403, "forbidden")["facts"]["needed"]
            assert needed == ("metrics" if path == "/metrics" else "admin"), path
        else:
            # A list, or something about the service: without ann and without any id of hers.
            assert not [known for known in world.ids.values() if known in answer.text], path
            assert '"ann"' not in answer.text, path
    assert tried > 15
    assert world.ask("ann", "get", "/v1/jobs/{job_id}").json()["state"] == "queued"


def test_a_read_only_key_changes_nothing(
    world: World, operations: list[tuple[str, str, dict[str, Any]]]
) -> None:
    refused = set()
    for method, path, _ in operations:
        answer = world.ask("reader", method, path)
        if method in SAFE or path in READS:
            admins = answer.status_code == 403 and method != "head"
            admins = admins and answer.json()["facts"]["needed"] in ("admin", "metrics")
            assert admins or answer.status_code not in (401, 403), (method, path)
        else:
            refusal = problem(answer, 403, "forbidden")
            assert refusal["facts"]["needed"] in ("train", "admin"), (method, path)
            assert repr(refusal["facts"]["needed"]) in refusal["detail"]
            refused.add((method, path))
    assert ("post", "/v1/jobs") in refused
    assert ("put", "/v1/captures/{capture_id}/{role}/{name}") in refused
    assert len(world.ask("ann", "get", "/v1/jobs").json()["jobs"]) == 2


def test_scopes_include_those_before_them(world: World) -> None:
    assert {scope.value: sorted(scope.permits) for scope in Scope} == {
        "read": ["read"],
        "train": ["read", "train"],
        "admin": ["admin", "metrics", "read", "train"],
        "metrics": ["metrics"],
    }
    assert world.ask("bob", "get", "/v1/me").json()["scopes"] == ["read", "train"]
    problem(world.ask("ann", "get", "/v1/keys"), 403, "forbidden")
    problem(world.ask("ann", "delete", "/v1/keys/{key_id}"), 403, "forbidden")
    assert world.ask("root", "get", "/v1/jobs/{job_id}").json()["owner"] == "ann"


def test_metrics_need_a_scope_of_their_own_which_permits_nothing_else(world: World) -> None:
    made = world.app.http.post(
        "/v1/keys",
        json={"name": "prometheus", "scopes": ["metrics"]},
        headers={"Authorization": "Bearer s3cret"},
    ).json()
    world.secrets["prometheus"] = made["secret"]
    for who in ("ann", "reader"):
        assert problem(world.ask(who, "get", "/metrics"), 403, "forbidden")["facts"]["needed"] == "metrics"
    for who in ("prometheus", "root"):
        assert "splatmill_redis_up 1.0" in world.ask(who, "get", "/metrics").text
    for path in ("/v1/me", "/v1/info", "/v1/jobs", "/v1/storage"):
        problem(world.ask("prometheus", "get", path), 403, "forbidden")


def test_only_an_admin_learns_the_machines_of_workers(world: World) -> None:
    worker = "rq:worker:render-7.lan-4711-abc123"
    world.app.redis.sadd("rq:workers", worker)
    world.app.redis.hset(worker, mapping={"state": "idle", "splatmill_lines": "any", "last_heartbeat": "x"})
    assert world.ask("root", "get", "/v1/info").json()["workers"][0]["name"] == "render-7.lan-4711-abc123"
    for who in ("ann", "reader", "bob"):
        shown = world.ask(who, "get", "/v1/info")
        assert [entry["name"] for entry in shown.json()["workers"]] == ["worker-1"]
        assert "render-7" not in shown.text
