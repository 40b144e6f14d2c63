"""Imports through the SDK and through `splatmill import`, against the real server and a real other one.

Not proved here: how a file is fetched, and what is refused (tests/server/background/test_imports.py, test_outgoing.py).
"""

import hashlib

import pytest
from typer.testing import CliRunner

from splatmill import Client
from splatmill.cli.app import app
from splatmill.cli.exits import Exit
from splatmill.errors import InvalidRequest, NotFound
from splatmill.schema import ImportState, Progress
from splatmill_server.base.settings import Settings

DATA = b"\xff\xd8\xff a photo" * 1000


@pytest.fixture
def settings(redis_url, tmp_path, peer, reply):
    """Those of the other tests, with leave to fetch from `peer`."""
    peer.answer = lambda request: reply(body=DATA) if "photo" in request.path else reply(status=404)
    allow = peer.url.removeprefix("http://")
    return Settings(redis_url=redis_url, data=tmp_path / "data", outgoing_allow=allow)


def test_a_file_is_fetched_into_a_capture(service, peer):
    heard: list[Progress] = []
    sha256 = hashlib.sha256(DATA).hexdigest()
    with Client(service.url) as client:
        begun = client.imports.start(f"{peer.url}/photo%201.jpg?key=1", sha256=sha256)
        done = client.imports.wait(begun.capture, begun.id, heard.append)
        assert (done.state, done.name) == (ImportState.succeeded, "photo 1.jpg")
        assert done.file is not None
        assert (heard[-1].done, heard[-1].total) == (len(DATA), len(DATA))
        more = client.imports.start(f"{peer.url}/photo", capture=begun.capture, role="masks", name="a.png")
        assert client.imports.wait(begun.capture, more.id).state is ImportState.succeeded
        assert [entry.id for entry in client.imports.list(begun.capture)] == [more.id, begun.id]
        capture = client.capture(begun.capture)
        assert capture.name == "photo%201.jpg"
        assert sorted(file.name for file in capture.files) == ["a.png", "photo 1.jpg"]
        gone = client.imports.start(f"{peer.url}/gone.jpg", capture=begun.capture)
        ended = client.imports.wait(begun.capture, gone.id)
        assert ended.state is ImportState.failed
        assert ended.problem is not None
        assert ended.problem.facts["status"] == 404
        with pytest.raises(NotFound):
            client.imports.get(begun.capture, "0" * 16)
        # A refused address leaves no capture behind.
        with pytest.raises(InvalidRequest, match="private"):
            client.imports.start("http://10.0.0.1/a.jpg")
        with pytest.raises(InvalidRequest, match="sha256"):
            client.imports.start(f"{peer.url}/photo", sha256="short")
        assert [entry.id for entry in client.captures()] == [begun.capture]


def test_the_command(service, peer):
    def run(*arguments: str):
        return CliRunner().invoke(app, ["import", *arguments, "--server", service.url])

    done = run(f"{peer.url}/photo.jpg")
    assert done.exit_code == 0, done.output
    assert "images/photo.jpg" in done.stdout
    capture = done.stdout.split()[-1]
    with Client(service.url) as client:
        assert [file.name for file in client.capture(capture).files] == ["photo.jpg"]
    again = run(f"{peer.url}/photo.jpg", "--capture", capture, "--role", "masks")
    assert again.stdout.split()[-1] == capture
    gone = run(f"{peer.url}/gone.jpg", "--capture", capture)
    assert gone.exit_code == Exit.error
    assert "404" in gone.output
    refused = run("http://10.0.0.1/a.jpg")
    assert refused.exit_code == Exit.refused
