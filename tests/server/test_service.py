"""The service's own pages, the API key, and what every answer has in common.

Not proved here: that a Prometheus server likes the metrics (their text is parsed with its own client library).
"""

import ast
import threading
from pathlib import Path

import pytest
import redis
from prometheus_client.parser import text_string_to_metric_families

from splatmill.backplane.storage.storage import StorageError
from splatmill.schema import MAX_PHOTO_PIXELS, MAX_RENDER_PIXELS, TrainOptions
from splatmill_server import app as app_module
from splatmill_server.app import create_app
from splatmill_server.background import sweeper
from splatmill_server.base.settings import Settings
from splatmill_server.space.usage import Usage
from tests.support.served_app import Serve, ServedApp, problem, served_app
from tests.support.waiting import wait_for


def test_a_stop_does_not_wait_until_all_of_storage_was_gone_through(
    redis_url: str, connection: redis.Redis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began, ended = threading.Event(), threading.Event()

    def endless(usage: Usage, lock: object = None) -> None:
        try:
            while True:
                usage.storage.exists("captures/none/capture.json")
                began.set()
        finally:
            ended.set()

    monkeypatch.setattr(Usage, "scan", endless)
    monkeypatch.setattr(sweeper, "_FIRST_SECONDS", 0.0)
    monkeypatch.setattr(app_module, "_STOP_SECONDS", 0.1)
    with served_app(Settings(redis_url=redis_url, data=tmp_path), connection) as app:
        wait_for(began.is_set)
        assert not ended.is_set()
    wait_for(ended.is_set)
    with pytest.raises(StorageError, match="closed"):
        app.service.storage.get("captures/none/capture.json")


def test_options_are_those_of_the_schema(app: ServedApp) -> None:
    options = app.http.get("/v1/options").json()["options"]
    assert [option["name"] for option in options] == list(TrainOptions.model_fields)
    assert all(option["help"] for option in options)


def test_health_readiness_and_info(app: ServedApp) -> None:
    assert app.http.get("/healthz").json() == {"status": "ok"}
    ready = app.http.get("/readyz")
    assert (ready.status_code, ready.json()["checks"]) == (
        200,
        {"redis": "ok", "redis_memory": "ok", "storage": "ok", "renderer": "none is configured"},
    )
    app.job()
    info = app.http.get("/v1/info").json()
    assert (info["name"], info["queued"], info["storage"], info["workers"]) == ("splatmill", 1, "file", [])
    assert info["limits"]["max_file_bytes"] == app.settings.max_file_bytes
    assert info["limits"]["max_image_pixels"] == MAX_PHOTO_PIXELS
    assert info["limits"]["max_render_pixels"] == MAX_RENDER_PIXELS


def test_metrics_count_by_route_and_not_by_id(app: ServedApp) -> None:
    job_id = app.job()
    for _ in range(3):
        app.http.get(f"/v1/jobs/{job_id}")
    app.http.get("/no/such/page")
    families = {f.name: f for f in text_string_to_metric_families(app.http.get("/metrics").text)}
    counts = {
        (s.labels["route"], s.labels["status"]): s.value
        for s in families["splatmill_http_requests"].samples
        if s.name.endswith("_total")
    }
    assert counts["/v1/jobs/{job_id}", "200"] == 3
    assert counts["other", "404"] == 1
    assert not any(job_id in route for route, _ in counts)
    assert families["splatmill_queue_length"].samples[0].value == 1
    assert families["splatmill_redis_up"].samples[0].value == 1


def test_addresses_and_methods_that_do_not_exist(app: ServedApp) -> None:
    problem(app.http.get("/no/such/page"), 404, "not_found")
    refused = app.http.patch("/v1/jobs")
    problem(refused, 405, "method_not_allowed")
    assert refused.headers["allow"] == "GET, POST"
    assert app.http.options("/v1/captures/x").headers["allow"] == "DELETE, GET"
    assert problem(app.http.get("/v1/jobs/x"), 404, "job_not_found")["instance"] == "/v1/jobs/x"


def test_every_answer_carries_its_request_id(app: ServedApp) -> None:
    assert app.http.get("/healthz", headers={"X-Request-ID": "abc-1"}).headers["x-request-id"] == "abc-1"
    for request_id in ("x" * 65, "a\tb", ""):
        made = app.http.get("/healthz", headers={"X-Request-ID": request_id}).headers["x-request-id"]
        assert made != request_id
        assert len(made) == 16


def test_a_key_is_asked_for_in_the_header_and_nowhere_else(serve: Serve) -> None:
    app = serve(api_key="s3cret")
    assert app.http.get("/v1/jobs").status_code == 200
    for header in ("", "Bearer wrong", "s3cret", "Bearer é"):
        answer = app.http.get("/v1/jobs?api_key=s3cret", headers={b"Authorization": header.encode()})
        problem(answer, 401, "unauthorized")
        assert answer.headers["www-authenticate"] == "Bearer"
        assert "s3cret" not in answer.text
    for address in ("/healthz", "/readyz", "/openapi.json"):
        assert app.http.get(address, headers={"Authorization": ""}).status_code == 200
    # The body is not read before the key is known to be right.
    answer = app.http.post(
        "/v1/captures", content=b"{", headers={"Authorization": "", "Content-Type": "application/json"}
    )
    problem(answer, 401, "unauthorized")


def test_the_document_describes_every_answer_with_examples(app: ServedApp) -> None:
    document = app.http.get("/openapi.json").json()
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            assert operation["summary"], (method, path)
            assert operation.get("description"), (method, path)
            if path.startswith("/v1/") and path != "/v1/options":
                kinds = {kind for r in operation["responses"].values() for kind in r.get("content", {})}
                assert "application/problem+json" in kinds, (method, path)
    assert "HTTPValidationError" not in document["components"]["schemas"]
    assert document["paths"]["/v1/jobs"]["post"]["requestBody"]["content"]["application/json"]["examples"]


def test_storage_that_cannot_be_opened_is_said_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(StorageError, match="cannot be created"):
        create_app(Settings(data=tmp_path / "file"))
    with pytest.raises(StorageError, match="neither file"):
        create_app(Settings(storage="ftp://x/y"))


def test_importing_the_server_runs_nothing() -> None:
    root = Path(app_module.__file__).parent
    assert (root / "background" / "reaper.py").is_file()
    for path in root.rglob("*.py"):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
                pytest.fail(f"{path}:{node.lineno} calls something when imported")


def test_a_mistake_of_ours_is_a_problem_with_a_request_id_and_the_next_request_works(app: ServedApp) -> None:
    app.service.storage.put("captures/" + "a" * 16 + "/capture.json", b'{"id": 7}')
    answer = app.http.get("/v1/captures/" + "a" * 16)
    assert problem(answer, 500, "internal_error")["advice"]
    assert answer.headers["x-request-id"]
    assert "Traceback" not in answer.text
    assert app.http.get("/v1/jobs").status_code == 200


def test_the_number_of_open_streams_is_known(app: ServedApp) -> None:
    job_id = app.job()

    def streams() -> str:
        return app.http.get("/metrics").text.split("\nsplatmill_event_streams ")[1].split()[0]

    with app.http.stream("GET", f"/v1/jobs/{job_id}/events") as answer:
        stream = answer.iter_raw()
        assert b"retry" in next(stream)
        assert streams() == "1.0"
    wait_for(lambda: streams() == "0.0")


def test_an_empty_variable_is_as_one_that_is_not_set(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (
        "SPLATMILL_QUOTA",
        "SPLATMILL_KEEP_CAPTURES",
        "SPLATMILL_PORT",
        "REDIS_URL",
        "SPLATMILL_STORAGE",
    ):
        monkeypatch.delenv(name, raising=False)
    unset = Settings()
    for name in (
        "SPLATMILL_QUOTA",
        "SPLATMILL_KEEP_CAPTURES",
        "SPLATMILL_PORT",
        "REDIS_URL",
        "SPLATMILL_STORAGE",
    ):
        monkeypatch.setenv(name, "")
    assert Settings() == unset
