"""No owner's deliveries hold up another's: receivers that hang, and webhooks that are deleted, over real HTTP.

Not proved here: what is delivered, and when it is repeated (test_webhooks).
"""

from collections.abc import Iterator
from typing import Any

import pytest

from splatmill.backplane.storage import layout
from splatmill.schema import CreateWebhook, Job
from splatmill_server.background import deliveries
from tests.support.served_app import Serve, ServedApp, stored
from tests.support.servers.scripted_server import Reply, Request, ScriptedServer, scripted_server
from tests.support.waiting import wait_for


@pytest.fixture
def peer() -> Iterator[ScriptedServer]:
    async def answer(request: Request) -> Reply:
        if request.path == "/hangs":
            return Reply(body=b"x" * 5000, pace=0.05)
        return Reply(body=b"thanks")

    with scripted_server() as server:
        server.answer = answer
        yield server


@pytest.fixture
def app(serve: Serve, peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch) -> ServedApp:
    monkeypatch.setattr(deliveries, "_LOOK_SECONDS", 0.1)
    monkeypatch.setattr(deliveries, "ANSWER_SECONDS", 600.0)
    monkeypatch.setattr(deliveries, "MAX_ANSWER", 5000)
    return serve(outgoing_allow=peer.url.removeprefix("http://"))


def webhook(app: ServedApp, url: str, owner: str) -> str:
    return app.service.webhooks.create(CreateWebhook(url=url), owner).id


def ended(app: ServedApp, owner: str) -> None:
    """Announce the end of a job of an owner."""
    job_id = app.job()
    app.http.post(f"/v1/jobs/{job_id}/cancel")
    job = Job.model_validate(app.http.get(f"/v1/jobs/{job_id}").json())
    app.service.webhooks.announce(job.model_copy(update={"owner": owner}), 1)


def states(app: ServedApp, webhook_id: str) -> list[Any]:
    log = app.http.get(f"/v1/webhooks/{webhook_id}/deliveries").json()["deliveries"]
    return [delivery["state"] for delivery in log]


def test_receivers_of_one_owner_that_hang_do_not_hold_up_another_owner(
    app: ServedApp, peer: ScriptedServer
) -> None:
    for _ in range(20):
        webhook(app, f"{peer.url}/hangs", "ann")
    good = webhook(app, f"{peer.url}/good", "bob")
    ended(app, "ann")
    wait_for(lambda: len(peer.requests) >= 4)
    ended(app, "bob")
    wait_for(lambda: states(app, good) == ["delivered"], 10)
    assert len([request for request in peer.requests if request.path == "/hangs"]) == 4


def test_the_deletion_of_a_webhook_ends_its_attempts_at_once(app: ServedApp, peer: ScriptedServer) -> None:
    made = webhook(app, f"{peer.url}/hangs", "ann")
    ended(app, "ann")
    wait_for(lambda: len(peer.requests) == 1)
    assert app.http.delete(f"/v1/webhooks/{made}").status_code == 204
    wait_for(lambda: peer.left == 1, 5)
    wait_for(lambda: not any(path.startswith(("webhooks", "due")) for path in stored(app)), 5)
    assert list(app.service.storage.entries(layout.due_deliveries())) == []
