"""Webhooks through the SDK and through `splatmill webhooks`, against the real server.

Not proved here: what is sent and when (tests/server/test_webhooks.py).
"""

import json

import pytest
from typer.testing import CliRunner

from splatmill import Client, verify_webhook
from splatmill.cli.app import app
from splatmill.errors import InvalidRequest, NotFound
from splatmill.schema import JobState, Problem, StateEvent, WebhookEvent
from splatmill_server.base.settings import Settings
from tests.support.waiting import wait_for


def end_a_job(service, client, tmp_path) -> str:
    (tmp_path / "photos").mkdir(exist_ok=True)
    for n in range(2):
        (tmp_path / "photos" / f"{n}.jpg").write_bytes(b"photo %d" % n)
    job = client.train(tmp_path / "photos")
    service.begin(job.id)
    service.say(job.id, StateEvent(state=JobState.failed, problem=Problem.of("diverged", "It went wrong.")))
    return str(job.id)


@pytest.fixture
def settings(redis_url, tmp_path, peer):
    """Those of the other tests, with leave to send to `peer`, which answers 200."""
    allow = peer.url.removeprefix("http://")
    return Settings(redis_url=redis_url, data=tmp_path / "data", reaper_interval=0.2, outgoing_allow=allow)


def delivered(client, webhook_id: str):
    wait_for(lambda: [d for d in client.webhooks.deliveries(webhook_id) if d.state == "delivered"])
    [delivery] = client.webhooks.deliveries(webhook_id)
    return delivery


def test_the_life_of_a_webhook(service, peer, tmp_path):
    with Client(service.url) as client:
        made = client.webhooks.create(peer.url, events=["job.failed"], name="pager")
        assert (made.url, made.events, made.name) == (peer.url, [WebhookEvent.failed], "pager")
        [listed] = client.webhooks.list()
        assert listed.id == made.id
        assert not hasattr(listed, "secret")
        rotated = client.webhooks.rotate(made.id)
        assert rotated.secret != made.secret
        job_id = end_a_job(service, client, tmp_path)
        delivery = delivered(client, made.id)
        assert (delivery.job, delivery.event) == (job_id, WebhookEvent.failed)
        assert delivery.attempts[0].status == 200
        payload = verify_webhook(
            peer.requests[0].headers, peer.requests[0].body, [made.secret, rotated.secret]
        )
        assert payload["data"]["id"] == job_id
        assert client.webhooks.repeat(made.id, delivery.id).state == "pending"
        wait_for(lambda: len(delivered(client, made.id).attempts) == 2)
        assert client.webhooks.enable(made.id).disabled_at is None
        client.webhooks.delete(made.id)
        assert client.webhooks.list() == []
        assert client.webhooks.create(peer.url).events == list(WebhookEvent)
        with pytest.raises(NotFound):
            client.webhooks.deliveries(made.id)
        with pytest.raises(InvalidRequest, match="private"):
            client.webhooks.create("http://10.0.0.1/")
        with pytest.raises(InvalidRequest, match="events"):
            client.webhooks.create(peer.url, events=["job.began"])


def test_the_commands(service, peer, tmp_path):
    def run(*arguments: str) -> str:
        result = CliRunner().invoke(app, ["webhooks", *arguments, "--server", service.url])
        assert result.exit_code == 0, result.output
        return result.stdout

    assert "There are no webhooks" in run("list")
    words = run("create", peer.url, "--event", "job.failed", "--name", "pager").split()
    webhook_id, secret = words[1], words[3]
    assert secret.startswith("whsec_")
    assert run("list").split() == [webhook_id, peer.url, "failed", "pager"]
    assert json.loads(run("list", "--json"))["id"] == webhook_id
    assert secret not in run("list", "--json")
    assert run("rotate", webhook_id).split()[3] != secret
    with Client(service.url) as client:
        job_id = end_a_job(service, client, tmp_path)
        delivered(client, webhook_id)
    shown = run("deliveries", webhook_id)
    assert job_id in shown
    assert "job.failed" in shown
    assert shown.split()[-2:] == ["200", "{}"]
    delivery = json.loads(run("deliveries", webhook_id, "--json"))["id"]
    assert delivery in run("repeat", webhook_id, delivery)
    assert webhook_id in run("enable", webhook_id)
    assert webhook_id in run("delete", webhook_id)
