"""Keys over real HTTP: made, listed, rotated, revoked, found in every API process, and stored as digests alone.

Not proved here: the limits of keys (test_limits), and what a key may request (test_permissions).
"""

import json
import re
from pathlib import Path
from typing import Any

import httpx
import pytest
from pydantic import SecretStr

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill_server.access.exposure import NeedsKey
from splatmill_server.access.keys import CACHE_SECONDS, digest
from splatmill_server.app import create_app
from splatmill_server.base.settings import Settings
from tests.support.served_app import Serve, ServedApp, problem, served_app, stored
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow  # a server for each case

ADMIN: dict[str, Any] = {"name": "root", "owner": "root", "scopes": ["admin"]}


def bearer(secret: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}" if secret else "none"}


def make(app: ServedApp, secret: str = "", **fields: Any) -> dict[str, Any]:
    """A new key, made with the key `secret`."""
    answer = app.http.post("/v1/keys", json=fields, headers=bearer(secret))
    assert answer.status_code == 201, answer.text
    assert answer.headers["cache-control"] == "no-store"
    made: dict[str, Any] = answer.json()
    return made


def me(app: ServedApp, secret: str) -> httpx.Response:
    return app.http.get("/v1/me", headers=bearer(secret))


def test_the_first_key_closes_the_server_and_is_an_admins(app: ServedApp) -> None:
    assert app.http.get("/v1/me").json()["scopes"] == ["read", "train", "admin", "metrics"]
    refused = app.http.post("/v1/keys", json={"name": "ann", "owner": "ann"})
    assert "admin" in problem(refused, 409, "admin_key_needed")["advice"]
    assert app.http.get("/v1/jobs").status_code == 200
    root = make(app, **ADMIN)
    problem(app.http.get("/v1/jobs"), 401, "unauthorized")
    ann = make(app, root["secret"], name="Ann's laptop", owner="ann")
    assert ann["scopes"] == ["read", "train"]
    caller = me(app, ann["secret"]).json()
    assert caller == {
        "owner": "ann",
        "key": ann["id"],
        "key_name": "Ann's laptop",
        "scopes": ["read", "train"],
        "limits": {"unfinished_jobs": None, "bytes_stored": None, "requests_per_minute": None},
        "use": {"unfinished_jobs": 0},
    }
    listed = app.http.get("/v1/keys", headers=bearer(root["secret"]))
    assert [key["name"] for key in listed.json()["keys"]] == ["root", "Ann's laptop"]
    one = app.http.get(f"/v1/keys/{ann['id']}", headers=bearer(root["secret"])).json()
    assert one == {name: value for name, value in ann.items() if name != "secret"}
    assert ann["secret"] not in listed.text


def test_a_secret_is_recognisable_and_stored_as_a_digest_alone(app: ServedApp) -> None:
    root = make(app, **ADMIN)
    assert re.fullmatch(rf"smk_{root['id']}_[0-9a-f]{{64}}", root["secret"])
    assert stored(app) == [f"keys/{root['id']}.json"]
    text = app.service.storage.get(layout.key_record(root["id"])).decode()
    assert digest(root["secret"]) in text
    assert root["secret"].rsplit("_", 1)[1] not in text
    assert json.loads(text)["format"] == 1


@pytest.mark.parametrize(
    "pattern",
    [
        "smk_",
        "smk_0000000000000000_" + "0" * 64,
        "smk_../../x_" + "0" * 64,
        "{id}",
        "{secret}0",
        "{Secret}",
        "{other}",
        "é",
    ],
)
def test_a_wrong_secret_is_refused(app: ServedApp, pattern: str) -> None:
    root = make(app, **ADMIN)
    other = root["secret"][:-1] + ("0" if root["secret"][-1] != "0" else "1")
    text = pattern.format(id=root["id"], secret=root["secret"], Secret=root["secret"].upper(), other=other)
    answer = app.http.get("/v1/me", headers={b"Authorization": f"Bearer {text}".encode()})
    problem(answer, 401, "unauthorized")
    assert answer.headers["www-authenticate"] == "Bearer"
    assert not text or text not in answer.text
    problem(app.http.get(f"/v1/me?key={root['secret']}"), 401, "unauthorized")


def test_a_rotated_key_has_a_new_secret_and_the_old_one_a_grace(app: ServedApp) -> None:
    root = make(app, **ADMIN)
    auth = bearer(root["secret"])
    ann = make(app, root["secret"], name="ann", owner="ann")
    path = f"/v1/keys/{ann['id']}/rotate"
    second = app.http.post(path, headers=auth).json()
    assert (second["id"], second["name"]) == (ann["id"], "ann")
    assert second["rotated_at"]
    assert second["former_valid_until"] is None
    assert [me(app, key["secret"]).status_code for key in (ann, second)] == [401, 200]
    third = app.http.post(path, json={"grace": "1h"}, headers=auth).json()
    assert third["former_valid_until"] > third["rotated_at"]
    assert [me(app, key["secret"]).status_code for key in (ann, second, third)] == [401, 200, 200]
    # A further rotation without a grace ends the former grace as well.
    fourth = app.http.post(path, json={"grace": 0}, headers=auth).json()
    assert [me(app, key["secret"]).status_code for key in (second, third, fourth)] == [401, 401, 200]
    fifth = app.http.post(path, json={"grace": 0.3}, headers=auth).json()
    assert me(app, fourth["secret"]).status_code == 200
    wait_for(lambda: me(app, fourth["secret"]).status_code == 401)
    assert me(app, fifth["secret"]).status_code == 200
    problem(app.http.post(path, json={"grace": "1y"}, headers=auth), 422, "invalid_request")
    problem(app.http.post("/v1/keys/0000000000000000/rotate", headers=auth), 404, "key_not_found")


def test_a_revoked_key_is_refused_and_stays_revoked(app: ServedApp) -> None:
    root = make(app, **ADMIN)
    auth = bearer(root["secret"])
    ann = make(app, root["secret"], name="ann", owner="ann")
    record = app.service.storage.get(layout.key_record(ann["id"]))
    assert app.http.delete(f"/v1/keys/{ann['id']}", headers=auth).status_code == 204
    problem(me(app, ann["secret"]), 401, "unauthorized")
    problem(app.http.delete(f"/v1/keys/{ann['id']}", headers=auth), 404, "key_not_found")
    # A rotation that began before writes its record last.
    app.service.storage.put(layout.key_record(ann["id"]), record)
    app.service.keys.read()
    problem(me(app, ann["secret"]), 401, "unauthorized")
    assert [key["name"] for key in app.http.get("/v1/keys", headers=auth).json()["keys"]] == ["root"]
    # Nobody could make keys without an admin.
    problem(app.http.delete(f"/v1/keys/{root['id']}", headers=auth), 409, "admin_key_needed")
    second = make(app, root["secret"], **ADMIN)
    assert app.http.delete(f"/v1/keys/{root['id']}", headers=bearer(second["secret"])).status_code == 204
    problem(me(app, root["secret"]), 401, "unauthorized")


def test_every_api_process_knows_of_a_change_within_the_stated_time(serve: Serve, app: ServedApp) -> None:
    other = serve()
    assert other.http.get("/v1/me").status_code == 200
    root = make(app, **ADMIN)
    wait_for(lambda: other.http.get("/v1/me").status_code == 401, CACHE_SECONDS + 8)
    assert me(other, root["secret"]).status_code == 200
    ann = make(other, root["secret"], name="ann", owner="ann")
    wait_for(lambda: me(app, ann["secret"]).status_code == 200, CACHE_SECONDS + 8)
    assert app.http.delete(f"/v1/keys/{ann['id']}", headers=bearer(root["secret"])).status_code == 204
    wait_for(lambda: me(other, ann["secret"]).status_code == 401, CACHE_SECONDS + 8)


def test_a_stream_of_events_ends_with_its_key(app: ServedApp) -> None:
    root = make(app, **ADMIN)
    auth = bearer(root["secret"])
    ann = make(app, root["secret"], name="ann", owner="ann")
    app.http.headers.update(bearer(ann["secret"]))
    job_id = app.job()
    with app.http.stream("GET", f"/v1/jobs/{job_id}/events") as answer:
        pieces = answer.iter_text()
        assert "retry" in next(pieces)
        assert app.http.delete(f"/v1/keys/{ann['id']}", headers=auth).status_code == 204
        assert "failed" not in "".join(pieces)  # it ends, while the job runs
    assert app.http.get(f"/v1/jobs/{job_id}", headers=auth).json()["state"] == "queued"


def test_the_key_of_the_setting_is_an_admin_beside_stored_keys(serve: Serve) -> None:
    app = serve(api_key="s3cret")
    ann = make(app, "s3cret", name="ann", owner="ann")
    assert me(app, ann["secret"]).json()["owner"] == "ann"
    caller = me(app, "s3cret").json()
    assert (caller["owner"], caller["key"], caller["key_name"]) == ("default", None, "SPLATMILL_API_KEY")
    root = make(app, "s3cret", **ADMIN)
    assert app.http.delete(f"/v1/keys/{root['id']}").status_code == 204


def test_keys_outlast_redis_and_restarts(app: ServedApp) -> None:
    root = make(app, **ADMIN)
    app.redis.flushall()
    with served_app(app.settings, app.redis) as again:
        problem(again.http.get("/v1/jobs"), 401, "unauthorized")
        assert me(again, root["secret"]).json()["owner"] == "root"


@pytest.mark.parametrize(
    "harm", [{"format": 2}, {"scopes": ["root"]}, {"limits": {"unfinished_jobs": "few"}}, {"secrets": None}]
)
def test_a_key_that_cannot_be_read_in_every_part_is_refused(app: ServedApp, harm: dict[str, Any]) -> None:
    root = make(app, **ADMIN)
    ann = make(app, root["secret"], name="ann", owner="ann")
    path = layout.key_record(ann["id"])
    record = json.loads(app.service.storage.get(path))
    app.service.storage.put(path, json.dumps(record | harm).encode())
    app.service.keys.read()
    problem(me(app, ann["secret"]), 401, "unauthorized")
    assert me(app, root["secret"]).status_code == 200
    app.service.storage.put(layout.key_record(root["id"]), b"not json")
    app.service.keys.read()
    # The server has keys, even if none can be read: it is not open to everybody.
    problem(app.http.get("/v1/me"), 401, "unauthorized")


def test_without_storage_no_key_is_accepted(
    serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = serve()
    root = make(app, **ADMIN)
    (tmp_path / "data" / "storage").rename(tmp_path / "away")
    (tmp_path / "data" / "storage").write_text("not a folder")
    monkeypatch.setattr("splatmill_server.access.keys.CACHE_SECONDS", 0.0)
    problem(me(app, root["secret"]), 503, "storage_unavailable")
    assert app.http.get("/healthz").status_code == 200


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"name": ""},
        {"name": "a\nb"},
        {"name": "x", "owner": "Ann"},
        {"name": "x", "owner": "../x"},
        {"name": "x", "owner": ""},
        {"name": "x", "scopes": []},
        {"name": "x", "scopes": ["root"]},
        {"name": "x", "limits": {"jobs": 3}},
        {"name": "x", "limits": {"unfinished_jobs": -1}},
        {"name": "x", "secret": "mine"},
    ],
)
def test_keys_that_cannot_be_made(app: ServedApp, body: dict[str, Any]) -> None:
    problem(app.http.post("/v1/keys", json=body), 422, "invalid_request")
    assert stored(app) == []


def test_other_machines_may_connect_when_a_key_is_stored(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path / "data", host="0.0.0.0")
    with pytest.raises(NeedsKey, match="SPLATMILL_API_KEY"):
        create_app(settings)
    assert create_app(settings.model_copy(update={"api_key": SecretStr("k")}))
    for loopback in ("127.0.0.1", "::1", "localhost", "127.1.2.3"):
        assert create_app(settings.model_copy(update={"host": loopback}))
    Storage(settings.storage).put(layout.key_record("a" * 16), b"{}")
    assert create_app(settings)


def test_a_server_that_others_reach_stays_closed_when_its_keys_are_gone(
    serve: Serve, app: ServedApp, tmp_path: Path
) -> None:
    root = make(app, **ADMIN)
    public = serve(host="0.0.0.0")
    assert me(public, root["secret"]).status_code == 200
    public.service.storage.delete(layout.key_record(root["id"]))
    public.service.keys.read()
    problem(public.http.get("/v1/jobs"), 401, "unauthorized")
