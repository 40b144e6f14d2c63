"""`storage` of the SDK and of the command line against the real server.

Not proved here: the figures themselves (tests/server/space).
"""

import asyncio
import json
from datetime import UTC, datetime, timedelta

from typer.testing import CliRunner

from splatmill.cli.app import app
from splatmill.sdk.aio import AsyncClient
from splatmill.sdk.client import Client
from tests.client.conftest import Service

WIDE = {"COLUMNS": "250", "TERM": "dumb", "NO_COLOR": "1"}


def _upload(service: Service, tmp_path) -> str:
    photos = tmp_path / "garden"
    photos.mkdir()
    for index in range(2):
        (photos / f"{index}.jpg").write_bytes(b"\xff\xd8\xff" + bytes([index]) * 5000)
    with Client(service.url) as client:
        capture, _ = client.upload(photos)
    return capture.id


def test_the_sdk_returns_the_use_of_storage(service: Service, tmp_path) -> None:
    capture = _upload(service, tmp_path)
    with Client(service.url) as client:
        use = client.storage(largest=1)
    assert [owner.owner for owner in use.owners] == ["default"]
    assert use.owners[0].bytes == use.owners[0].by_kind.total > 10_000
    assert [(record.kind.value, record.id, record.name) for record in use.largest] == [
        ("capture", capture, "garden")
    ]

    async def both() -> None:
        async with AsyncClient(service.url) as client:
            assert (await client.storage(owner="default")).owners == use.owners
            assert (await client.storage(owner="nobody")).owners[0].bytes == 0

    asyncio.run(both())


def test_the_command_prints_owners_and_the_largest_records(service: Service, tmp_path) -> None:
    capture = _upload(service, tmp_path)
    shown = CliRunner().invoke(app, ["storage", "--server", service.url], env=WIDE)
    assert shown.exit_code == 0, shown.output
    lines = [line.split() for line in shown.output.splitlines()]
    assert lines[0] == ["owner", "total", "captures", "cameras", "jobs", "models", "uploads", "limit"]
    assert lines[1][:3] == ["default", "10.3", "kB"]
    row = next(line for line in lines if capture in line)
    assert row[:4] == [capture, "garden", "capture", "default"]
    assert row[-2:] == ["on", "request"]
    assert "The next sweep deletes nothing." in shown.output
    as_json = CliRunner().invoke(app, ["storage", "--server", service.url, "--json"], env=WIDE)
    assert json.loads(as_json.output)["largest"][0]["id"] == capture


def test_a_capture_in_use_names_its_job(service: Service, tmp_path) -> None:
    capture = _upload(service, tmp_path)
    with Client(service.url) as client:
        job = client.submit(capture).id
    shown = CliRunner().invoke(app, ["storage", "--server", service.url], env=WIDE)
    assert f"not before job {job} ends" in shown.output


def test_planned_deletions_and_expiries_are_shown_with_whole_ids(peer, reply) -> None:
    now = datetime.now(UTC)
    capture, model = "c" * 32, "d" * 16
    known = {"owner": "lab", "bytes": 2_000_000, "last_used": (now - timedelta(days=40)).isoformat()}
    use = {
        "scanned_at": now.isoformat(),
        "owners": [
            {"owner": "lab", "bytes": 3_000_000, "limit": 5_000_000},
            {"owner": None, "bytes": 7},
        ],
        "largest": [
            {"kind": "capture", "id": capture, "files": 3, **known, "expires_at": now.isoformat()},
            {"kind": "model", "id": model, "files": 3, **known, "expires_at": _later(now, days=9.9)},
        ],
        "deletions": [
            {
                "kind": "capture",
                "id": capture,
                "owner": "lab",
                "bytes": 2_000_000,
                "reason": "It was not used for 30 days.",
            }
        ],
    }
    peer.answer = lambda _: reply(body=json.dumps(use).encode())
    shown = CliRunner().invoke(app, ["storage", "--server", peer.url, "--owner", "lab", "-n", "2"])
    assert shown.exit_code == 0, shown.output
    assert peer.requests[0].path == "/v1/storage?largest=2&owner=lab"
    lines = [" ".join(line.split()) for line in shown.output.splitlines()]
    assert "lab 3.0 MB 0 B 0 B 0 B 0 B 0 B 5.0 MB" in lines
    assert "(nobody) 7 B 0 B 0 B 0 B 0 B 0 B none" in lines
    assert f"{capture} capture lab 2.0 MB 40 d ago by the next sweep" in lines
    assert f"{model} model lab 2.0 MB 40 d ago in 10 d" in lines
    assert "The next sweep deletes 2.0 MB:" in lines
    assert lines[-1] == f"{capture} capture 2.0 MB It was not used for 30 days."


def _later(now: datetime, *, days: float) -> str:
    return (now + timedelta(days=days)).isoformat()
