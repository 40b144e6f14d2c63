"""Links to a model through the SDK and through `splatmill shares`, on the real server.

Not proved here: what a link opens, and for whom (tests/server/models/test_shares.py).
"""

import json

import httpx
import pytest
from typer.testing import CliRunner

from splatmill import Client
from splatmill.cli.app import app
from splatmill.errors import InvalidRequest, NotFound
from tests.support.served_app import store_model

MODEL = "0123456789abcdef"


@pytest.fixture
def url(service):
    store_model(service, MODEL)
    return service.url


def test_the_life_of_a_link(url):
    with Client(url) as client:
        shares = client.model(MODEL).shares
        made = shares.create(expires_in="2h", name="for mum")
        assert (made.model, made.name, made.active) == (MODEL, "for mum", True)
        assert (made.expires_at - made.created_at).total_seconds() == 7200
        assert httpx.get(f"{url.rstrip('/')}{made.path}/model", timeout=60).json()["id"] == MODEL
        assert [share.id for share in shares.list()] == [made.id]
        shares.revoke(made.id)
        [ended] = shares.list()
        assert ended.revoked_at is not None
        assert not ended.active
        assert httpx.get(f"{url.rstrip('/')}{made.path}/model", timeout=60).status_code == 410
        with pytest.raises(NotFound, match="has no link"):
            shares.revoke("00000000")
        with pytest.raises(InvalidRequest, match="expires_in"):
            shares.create(expires_in="for ever")
        made = shares.create()
        assert (made.expires_at - made.created_at).days == 30


def test_the_command_prints_the_whole_address(url):
    def invoke(*arguments: str):
        return CliRunner().invoke(app, ["shares", *arguments, "--server", url])

    assert "There are no links" in invoke("list", MODEL).stdout
    printed = invoke("create", MODEL, "--expires-in", "90s", "--name", "for mum").stdout.splitlines()
    address = printed[-1]
    assert address.startswith(f"{url.rstrip('/')}/s/{MODEL}-")
    assert httpx.get(f"{address}/model", timeout=60).status_code == 200
    listed = json.loads(invoke("list", MODEL, "--json").stdout)
    assert listed["name"] == "for mum"
    assert "for mum" in invoke("list", MODEL).stdout
    assert "valid until" in invoke("list", MODEL).stdout
    assert "is revoked" in invoke("revoke", MODEL, listed["id"]).stdout
    assert "revoked" in invoke("list", MODEL).stdout
    assert httpx.get(f"{address}/model", timeout=60).status_code == 410
