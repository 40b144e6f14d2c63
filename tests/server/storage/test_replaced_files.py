"""Proves that a file which is replaced or deleted between looking it up and reading it is answered whole or as missing.

Proven with files and on a bucket (tests.support.servers.bucket). A replacement while the bytes flow is in test_bucket.
"""

from collections.abc import Iterator
from typing import Any

import pytest

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Entry
from tests.support.served_app import Serve, ServedApp
from tests.support.servers.bucket import bucket


@pytest.fixture(params=["files", "bucket"])
def app(serve: Serve, request: pytest.FixtureRequest) -> Iterator[ServedApp]:
    if request.param == "files":
        yield serve()
        return
    with bucket() as url:
        yield serve(storage=url)


class Preview:
    """The preview of a job, which changes between two requests."""

    def __init__(self, app: ServedApp) -> None:
        job_id = app.job()
        app.begin(job_id)
        app.finish(job_id)
        self.address = f"/v1/jobs/{job_id}/preview"
        self._path = layout.model_file(job_id, "preview.jpg")
        self._storage = app.service.storage

    def replace_after_each_look(self, monkeypatch: pytest.MonkeyPatch, contents: list[bytes | None]) -> None:
        """Store the next contents after each look at the file; None deletes it."""
        look = self._storage.head

        def head(path: str) -> Entry | None:
            entry = look(path)
            if path == self._path and contents:
                following = contents.pop(0)
                if following is None:
                    self._storage.delete(path)
                else:
                    self._storage.put(path, following)
            return entry

        monkeypatch.setattr(self._storage, "head", head)


@pytest.fixture
def preview(app: ServedApp) -> Preview:
    return Preview(app)


def get(app: ServedApp, preview: Preview) -> Any:
    return app.http.get(preview.address)


@pytest.mark.parametrize("newer", [b"n", b"newer" * 1000])
def test_a_preview_that_is_replaced_meanwhile_is_sent_whole(
    app: ServedApp, preview: Preview, monkeypatch: pytest.MonkeyPatch, newer: bytes
) -> None:
    preview.replace_after_each_look(monkeypatch, [b"between" * 10, newer])
    answer = get(app, preview)
    assert (answer.status_code, answer.content) == (200, newer)
    assert answer.headers["content-length"] == str(len(newer))


def test_a_file_that_is_deleted_meanwhile_is_missing(
    app: ServedApp, preview: Preview, monkeypatch: pytest.MonkeyPatch
) -> None:
    preview.replace_after_each_look(monkeypatch, [None])
    answer = get(app, preview)
    assert answer.status_code == 404
    assert answer.json()["code"] == "file_not_found"


def test_a_file_that_is_replaced_at_every_look_is_no_endless_loop(
    app: ServedApp, preview: Preview, monkeypatch: pytest.MonkeyPatch
) -> None:
    preview.replace_after_each_look(monkeypatch, [b"%d" % number * number for number in range(1, 30)])
    answer = get(app, preview)
    assert answer.status_code == 503
    assert "replaced meanwhile" in answer.text
