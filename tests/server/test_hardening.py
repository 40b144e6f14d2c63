"""What strangers may send or see: deep nesting, secrets in addresses, unauthenticated requests, pages from elsewhere.

Not proved here: limits on how much one client may request.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from splatmill.backplane.connection import InvalidRedisUrl, connect, connect_async
from splatmill.backplane.redact import redacted
from splatmill_server import service
from splatmill_server.access.exposure import NeedsKey
from splatmill_server.app import create_app
from splatmill_server.base.settings import Settings
from tests.support.served_app import Serve, ServedApp

pytestmark = pytest.mark.slow  # a server for each case

PHOTO = b"\xff\xd8\xff a photo"
PASSWORD = "hunter2"


@pytest.mark.parametrize("depth", [50, 190, 250, 500, 900, 990, 1500, 20_000])
@pytest.mark.parametrize("shape", ["[{}]", '{{"a":{}}}', '{{"preset":{}}}', '{{"test_views":[{}]}}'])
def test_deeply_nested_json_is_refused_by_name(app: ServedApp, depth: int, shape: str) -> None:
    opening, closing = shape.format("\0").split("\0")
    nested = opening * depth + "1" + closing * depth
    files = [("images", (f"{i}.jpg", PHOTO + b"%d" % i)) for i in range(2)]
    answer = app.http.post("/v1/jobs", files=files, data={"options": nested})
    assert 400 <= answer.status_code < 500, answer.text
    assert answer.json()["code"] in {
        "malformed_body",
        "unknown_option",
        "invalid_request",
        "option_out_of_range",
    }
    json_type = {"Content-Type": "application/json"}
    for path, body in (
        ("/v1/jobs", f'{{"capture": "x", "options": {nested}}}'),
        ("/v1/captures", f'{{"name": {nested}}}'),
        ("/v1/captures", nested),
    ):
        answer = app.http.post(path, content=body, headers=json_type)
        assert 400 <= answer.status_code < 500, (path, answer.text)
    assert app.http.get("/v1/captures").json()["captures"] == []


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        (f"redis://:{PASSWORD}@host:6379/0", "redis://:***@host:6379/0"),
        (f"redis://user:{PASSWORD}@host/0", "redis://user:***@host/0"),
        (f"redis://user:a@{PASSWORD}/?#@host:1/0", "redis://user:***@host:1/0"),
        (f"redis://{PASSWORD}@host", "redis://***@host"),
        (f"redis://host/0?password={PASSWORD}&db=1", "redis://host/0?password=***&db=1"),
        (f"unix://:{PASSWORD}@/run/redis.sock", "unix://:***@/run/redis.sock"),
        (PASSWORD, "***"),
        (f":{PASSWORD}@host:6379", "***"),
        ("redis://127.0.0.1:6379/0", "redis://127.0.0.1:6379/0"),
        ("unix:///run/redis.sock", "unix:///run/redis.sock"),
        ("file:///data/storage", "file:///data/storage"),
        ("/data/storage", "/data/storage"),
    ],
)
def test_addresses_are_shown_without_their_secrets(url: str, shown: str) -> None:
    assert redacted(url) == shown


NOT_VALID = [
    f"redis://:{PASSWORD}@[::1",
    f"redis://:x#{PASSWORD}@host:1/0",
    f"redis://u:{PASSWORD}/x@host:1/0",
    PASSWORD,
]


@pytest.mark.parametrize("url", NOT_VALID)
def test_an_address_that_is_not_valid_is_refused_without_its_password(url: str) -> None:
    for open_client in (connect, connect_async):
        with pytest.raises(InvalidRedisUrl, match="percent-encoded") as caught:
            open_client(url)
        assert PASSWORD not in str(caught.value)
        assert caught.value.__suppress_context__


# Only the doctor does not wait for a Redis that does not answer. That no form of an address that is not valid is shown
# is tested above, for all programs at once.
@pytest.mark.parametrize(
    ("program", "url"),
    [
        ("doctor", f"redis://:{PASSWORD}@127.0.0.1:1/0"),
        *((name, NOT_VALID[1]) for name in ("doctor", "train", "server")),
    ],
)
def test_no_program_prints_the_password_of_redis(url: str, program: str, tmp_path: Path) -> None:
    module = ["splatmill_server"] if program == "server" else ["splatmill_worker", program]
    ran = subprocess.run(
        [sys.executable, "-m", *module],
        env=os.environ | {"REDIS_URL": url, "SPLATMILL_DATA": str(tmp_path / "data"), "SPLATMILL_PORT": "0"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ran.returncode in (1, 2), ran.stderr
    assert "edis" in ran.stdout + ran.stderr
    assert PASSWORD not in ran.stdout + ran.stderr
    assert "Traceback" not in ran.stderr


def test_the_settings_do_not_show_the_password(tmp_path: Path) -> None:
    assert PASSWORD not in repr(Settings(redis_url=f"redis://:{PASSWORD}@h/0"))
    with pytest.raises(NeedsKey, match="access") as caught:
        create_app(Settings(redis_url=f"redis://:{PASSWORD}@h/0", host="0.0.0.0", data=tmp_path))
    assert PASSWORD not in str(caught.value)


def test_readiness_writes_to_storage_once_in_a_while(
    serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = serve()
    for _ in range(3):
        assert app.http.get("/readyz").json()["checks"]["storage"] == "ok"
    # Where every further write would fail, a request within the interval does not notice, because it does not write.
    (tmp_path / "data" / "storage").rename(tmp_path / "away")
    (tmp_path / "data" / "storage").write_text("not a folder")
    assert app.http.get("/readyz").status_code == 200
    monkeypatch.setattr(service, "CHECK_SECONDS", 0.0)
    answer = app.http.get("/readyz")
    assert answer.status_code == 503
    said = "Storage cannot be read or written; the log of the server has the reason."
    assert answer.json()["checks"]["storage"] == said


def test_the_page_of_endpoints_loads_nothing(app: ServedApp) -> None:
    answer = app.http.get("/docs")
    assert answer.status_code == 200
    assert "default-src 'none'" in answer.headers["content-security-policy"]
    text = answer.text
    assert not any(part in text for part in ("http://", "https://", "<script", "<link", "src=", "@import"))
    paths = app.http.get("/openapi.json").json()["paths"]
    assert all(path in text for path in paths)
    assert 'href="openapi.json"' in text
