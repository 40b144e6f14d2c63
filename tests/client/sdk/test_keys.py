"""Keys through the SDK and through `splatmill keys`, against the real server.

Not proved here: what the server does with a key (tests/server/access/test_keys.py).
"""

import json
import re

import pytest
from typer.testing import CliRunner

from splatmill import Client
from splatmill.cli.app import app
from splatmill.cli.exits import Exit
from splatmill.errors import Conflict, InvalidRequest, NotFound, Unauthorized
from splatmill.schema import KeyLimits, Scope


def test_the_life_of_a_key(service):
    with Client(service.url) as client:
        with pytest.raises(Conflict) as caught:
            client.keys.create("ann", owner="ann")
        assert caught.value.code == "admin_key_needed"
        root = client.keys.create("root", scopes=[Scope.admin])
        with pytest.raises(Unauthorized):
            client.keys.list()
    with Client(service.url, api_key=root.secret) as client:
        ann = client.keys.create("ann", owner="ann", limits={"unfinished_jobs": 2})
        bob = client.keys.create("bob", owner="bob", scopes=["read"], limits=KeyLimits(requests_per_minute=9))
        assert [(key.name, key.scopes) for key in client.keys.list()] == [
            ("root", [Scope.admin]),
            ("ann", [Scope.read, Scope.train]),
            ("bob", [Scope.read]),
        ]
        with Client(service.url, api_key=ann.secret) as hers:
            me = hers.me()
            assert (me.owner, me.key, me.limits.unfinished_jobs, me.use.unfinished_jobs) == (
                "ann",
                ann.id,
                2,
                0,
            )
        fresh = client.keys.rotate(ann.id)
        with Client(service.url, api_key=fresh.secret) as hers:
            assert hers.me().key == ann.id
        with Client(service.url, api_key=ann.secret) as hers, pytest.raises(Unauthorized):
            hers.me()
        later = client.keys.rotate(ann.id, grace="1h")
        assert later.former_valid_until is not None
        for secret in (fresh.secret, later.secret):
            with Client(service.url, api_key=secret) as hers:
                assert hers.me().owner == "ann"
        client.keys.revoke(bob.id)
        assert [key.name for key in client.keys.list()] == ["root", "ann"]
        with pytest.raises(NotFound):
            client.keys.revoke(bob.id)
        with pytest.raises(InvalidRequest, match="owner"):
            client.keys.create("x", owner="Not An Owner")
        with pytest.raises(InvalidRequest, match="is not a duration"):
            client.keys.rotate(ann.id, grace="soon")


def test_the_command_line(service):
    def run(*arguments: str, key: str = ""):
        env = {"SPLATMILL_SERVER": service.url, "SPLATMILL_API_KEY": key, "COLUMNS": "250", "NO_COLOR": "1"}
        return CliRunner().invoke(app, ["keys", *arguments], env=env)

    assert "There are no stored keys" in run("list").stdout
    refused = run("create", "ann")
    assert (refused.exit_code, "admin" in refused.stderr) == (Exit.not_found, True)
    made = run("create", "root", "--scope", "admin")
    root = made.stdout.strip()
    assert re.fullmatch(r"smk_[0-9a-f]{16}_[0-9a-f]{64}", root)
    assert root not in made.stderr
    assert run("list").exit_code == Exit.unauthorized
    limits = ("--jobs", "3", "--bytes", "20GB", "--requests", "600")
    ann = run("create", "Ann's laptop", "--owner", "ann", *limits, key=root).stdout.strip()
    key_id = ann.split("_")[1]
    listed = run("list", key=root).stdout
    assert "unfinished jobs 3, bytes stored 20000000000, requests per minute 600" in listed
    assert ann not in listed
    lines = [json.loads(line) for line in run("list", "--json", key=root).stdout.splitlines()]
    assert [(line["name"], line["scopes"]) for line in lines] == [
        ("root", ["admin"]),
        ("Ann's laptop", ["train"]),
    ]
    rotated = run("rotate", key_id, "--grace", "1h", key=root)
    assert "valid until" in rotated.stderr
    assert rotated.stdout.strip() != ann
    assert run("list", key=ann).exit_code == Exit.unauthorized  # 403: a train key makes no keys
    assert "is revoked" in run("revoke", key_id, key=root).stdout
    assert run("revoke", key_id, key=root).exit_code == Exit.not_found
    assert run("create", "x", "--bytes", "many", key=root).exit_code == Exit.usage
    assert run("create", "x", "--scope", "root", key=root).exit_code == Exit.usage
    shown = run("--help").stdout
    assert all(name in shown for name in ("create", "list", "revoke", "rotate"))
