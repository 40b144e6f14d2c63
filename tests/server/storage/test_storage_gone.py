"""Who reads what storage says when it fails: its messages name folders, hosts and buckets, and only admins see them.

Not proved here: how the server recovers when storage is back (test_bucket), and what Redis says (test_redis_gone).
"""

import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from splatmill.backplane.storage import errors as storage_errors
from splatmill_server.access import keys as access_keys
from splatmill_server.base.problems import storage_trouble
from tests.support.served_app import Serve, ServedApp, problem, store_model

pytestmark = pytest.mark.slow

MODEL = "a" * 16
LOGGED = "the log of the server has the reason"
SECRETS = ("secret-place", "captures/", "keys", "health/", "models/", "os error")
ADMIN = {"Authorization": "Bearer s3cret"}


def break_storage(app: ServedApp) -> None:
    """Put a file in the place of the folder."""
    root = app.service.storage.root
    assert root is not None
    shutil.move(root, root.with_name("away"))
    root.write_text("not a folder")


@pytest.fixture
def app(serve: Serve, tmp_path: Path) -> ServedApp:
    """A server whose folder has a name that strangers shall not learn."""
    return serve(api_key="s3cret", data=tmp_path / "secret-place")


def test_only_admins_read_what_storage_says(app: ServedApp, monkeypatch: pytest.MonkeyPatch) -> None:
    store_model(app.service, MODEL)
    link = app.http.post(f"/v1/models/{MODEL}/shares", json={}).json()["path"]
    ann = app.http.post("/v1/keys", json={"name": "ann", "owner": "ann"}).json()["secret"]
    capture = app.http.post("/v1/captures", json={}, headers={"Authorization": f"Bearer {ann}"}).json()["id"]
    put, page = f"/v1/captures/{capture}/images/a.jpg", f"/v1/captures/{capture}"
    monkeypatch.setattr(access_keys, "CACHE_SECONDS", 3600.0)
    app.http.get("/v1/me", headers={"Authorization": f"Bearer {ann}"})
    break_storage(app)
    whole = app.http.get(page, headers=ADMIN)
    assert "secret-place" in problem(whole, 503, "storage_unavailable")["detail"]
    keyed: Any = {"headers": {"Authorization": f"Bearer {ann}"}}
    stranger: Any = {"headers": {"Authorization": "none", "Accept": "application/json"}}
    asked: list[tuple[str, Callable[[], Any]]] = [
        ("a page of an owner", lambda: app.http.get(page, **keyed)),
        ("a file of an owner", lambda: app.http.put(put, content=b"x", **keyed)),
        ("a shared link", lambda: app.http.get(f"{link}/model", **stranger)),
    ]
    for what, ask in asked:
        with capture_logs() as lines:
            answer = ask()
        assert LOGGED in problem(answer, 503, "storage_unavailable")["detail"], what
        assert not [name for name in SECRETS if name in answer.json()["detail"]], (what, answer.text)
        assert any("secret-place" in str(line.get("error")) for line in lines), what
    monkeypatch.setattr(access_keys, "CACHE_SECONDS", 0.0)
    answer = app.http.get("/v1/jobs", headers={"Authorization": "Bearer of-nobody"})
    assert LOGGED in problem(answer, 503, "storage_unavailable")["detail"]
    assert not [name for name in SECRETS if name in answer.json()["detail"]], answer.text


def test_readiness_names_no_folder(app: ServedApp) -> None:
    break_storage(app)
    with capture_logs() as lines:
        answer = app.http.get("/readyz", headers={"Authorization": "none"})
    assert answer.status_code == 503
    assert answer.json()["checks"]["storage"] == f"Storage cannot be read or written; {LOGGED}."
    assert any("secret-place" in str(line.get("error")) for line in lines)


def test_readiness_names_no_host_and_no_bucket(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # and does not listen
        endpoint = f"127.0.0.1:{unused.getsockname()[1]}"
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{endpoint}")
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", "a")
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "b")
        app = serve(storage="s3://secret-bucket/x", api_key="s3cret")
        answer = app.http.get("/readyz", headers={"Authorization": "none"}, timeout=60)
    assert answer.status_code == 503
    for name in (endpoint, "secret-bucket", "health/"):
        assert name not in answer.text
    assert "torage" in answer.json()["checks"]["storage"]


def test_every_error_of_storage_has_a_sentence_for_anybody() -> None:
    kinds = [
        kind
        for kind in vars(storage_errors).values()
        if isinstance(kind, type) and issubclass(kind, storage_errors.StorageError)
    ]
    assert len(kinds) == 6
    said = {storage_trouble(kind("s3://secret-bucket/x: os error 5")) for kind in kinds}
    assert len(said) == len(kinds)
    for sentence in said:
        assert sentence.endswith(f"; {LOGGED}.")
        assert "secret" not in sentence
