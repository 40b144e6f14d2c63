"""The access log: who, what, status, seconds, bytes and request id, one line a request, which a setting turns off."""

from typing import Any

import pytest
from structlog.testing import CapturingLogger

from splatmill.backplane.jobs.row import request_of
from splatmill_server.jobs import requests as job_requests
from tests.support.served_app import Serve

pytestmark = pytest.mark.slow


def requests(captured: CapturingLogger) -> list[dict[str, Any]]:
    """The lines of requests at the level info, which is the service's."""
    logged = (dict(call.kwargs) for call in captured.calls)
    return [line for line in logged if line.get("event") == "request" and line["level"] == "info"]


def test_a_request_is_one_line(serve: Serve, lines: CapturingLogger) -> None:
    app = serve(api_key="s3cret")
    made = app.http.post("/v1/keys", json={"name": "Ann's laptop", "owner": "ann", "scopes": ["read"]}).json()
    auth = {"Authorization": f"Bearer {made['secret']}", "X-Request-ID": "abc-1"}
    answer = app.http.get("/v1/me?page=1", headers=auth)
    app.http.post("/v1/captures", headers=auth)
    app.http.get("/v1/jobs", headers={"Authorization": "none"})
    app.http.get("/healthz")
    created, me, refused, nobody = requests(lines)
    seconds = me.pop("seconds")
    assert me == {
        "event": "request",
        "level": "info",
        "request": "abc-1",
        "owner": "ann",
        "key": "Ann's laptop",
        "method": "GET",
        "path": "/v1/me",
        "status": 200,
        "bytes": len(answer.content),
    }
    assert 0 <= seconds < 60
    assert (created["owner"], created["key"], created["status"]) == ("default", "SPLATMILL_API_KEY", 201)
    assert (refused["owner"], refused["status"]) == ("ann", 403)
    assert (nobody["owner"], nobody["key"], nobody["status"]) == ("", "", 401)
    assert made["secret"] not in str(lines.calls)


def test_a_request_is_followed_to_its_job(serve: Serve, lines: CapturingLogger) -> None:
    app = serve()
    capture = app.capture()
    made = app.http.post("/v1/jobs", json={"capture": capture}, headers={"X-Request-ID": "ann-7"})
    job_id = made.json()["id"]
    app.http.get(f"/v1/jobs/{job_id}")
    assert request_of(app.redis, job_id) == "ann-7"
    [created] = [call.kwargs for call in lines.calls if call.kwargs["event"] == "job created"]
    assert (created["job"], created["capture"]) == (job_id, capture)
    assert requests(lines)[-1]["job"] == job_id
    # A restart is asked for by another request, which is the one to follow then.
    app.http.post(f"/v1/jobs/{job_id}/cancel")
    app.service.reaper.tick()
    app.http.post(f"/v1/jobs/{job_id}/restart", headers={"X-Request-ID": "bob-8"}).raise_for_status()
    assert request_of(app.redis, job_id) == "bob-8"
    kept = job_requests.get(app.service.storage, job_id)
    assert kept is not None
    assert kept.request == "bob-8", "it is restored with the job"


def test_it_can_be_turned_off(serve: Serve, lines: CapturingLogger) -> None:
    app = serve(access_log=False)
    app.http.get("/v1/me")
    assert requests(lines) == []
