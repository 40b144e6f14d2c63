"""The manifest of a capture, and how many operations of storage uploads and looks need: counted at a proxy before a
bucket (moto's server). Captures of versions without manifests are read, and get one.

Not proved here: uploads that race for a name in a folder (test_captures), and how long operations take.
"""

import hashlib
import json
import secrets
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from splatmill.backplane.storage import layout
from splatmill.schema import Role
from splatmill_server.captures import digests
from tests.support.served_app import Serve, ServedApp, problem
from tests.support.servers.faulty_s3 import FaultyS3, Request, faulty_s3

pytestmark = pytest.mark.slow

PHOTOS = 40


@pytest.fixture(scope="module")
def served() -> Iterator[FaultyS3]:
    with faulty_s3() as s3:
        yield s3


@pytest.fixture
def s3(served: FaultyS3) -> Iterator[FaultyS3]:
    served.storage = f"{served.storage.rsplit('/', 1)[0]}/{secrets.token_hex(8)}"
    yield served
    served.reset()


@pytest.fixture
def app(s3: FaultyS3, serve: Serve) -> ServedApp:
    return serve(storage=s3.storage)


def photo(number: int) -> bytes:
    return b"\xff\xd8\xff photo %d" % number


def upload(app: ServedApp, count: int = PHOTOS) -> str:
    capture_id = str(app.http.post("/v1/captures", json={}).json()["id"])
    for number in range(count):
        answer = app.http.put(f"/v1/captures/{capture_id}/images/{number:03}.jpg", content=photo(number))
        assert answer.status_code == 201, answer.text
    return capture_id


def look(app: ServedApp, capture_id: str) -> dict[str, str]:
    """Name and digest of each file, as the API lists them."""
    listed = app.http.get(f"/v1/captures/{capture_id}").json()["files"]
    return {file["name"]: file["sha256"] for file in listed}


def of(s3: FaultyS3, capture_id: str) -> list[Request]:
    """The requests about a capture since the last call."""
    requests, s3.requests = s3.requests, []
    return [request for request in requests if capture_id in request.path]


EXPECTED = {f"{number:03}.jpg": hashlib.sha256(photo(number)).hexdigest() for number in range(PHOTOS)}


def test_an_upload_costs_three_operations_and_a_look_four_at_most(s3: FaultyS3, app: ServedApp) -> None:
    capture_id = upload(app, 0)
    app.http.put(
        f"/v1/captures/{capture_id}/images/first.jpg", content=b"first"
    )  # it lists and reads the record
    of(s3, capture_id)
    for number in range(PHOTOS):
        app.http.put(f"/v1/captures/{capture_id}/images/{number:03}.jpg", content=photo(number))
    operations = of(s3, capture_id)
    # Each: the digest that claims the name, the bytes, and whether the capture is still there. The record is read anew
    # every five seconds.
    steps = [request for request in operations if request.method in ("PUT", "HEAD")]
    assert len(steps) == 3 * PHOTOS
    assert len(operations) <= 3 * PHOTOS + 3
    assert len(look(app, capture_id)) == PHOTOS + 1
    first = of(s3, capture_id)
    # The record, the list of files, no manifest; it is written, and the capture is still there.
    assert [request.method for request in first] == ["GET", "GET", "GET", "PUT", "HEAD"]
    assert look(app, capture_id) == EXPECTED | {"first.jpg": hashlib.sha256(b"first").hexdigest()}
    assert [request.method for request in of(s3, capture_id)] == ["GET", "GET", "GET"]


def test_another_process_reads_the_manifest_and_the_digests_that_it_lacks(
    s3: FaultyS3, app: ServedApp, serve: Serve
) -> None:
    capture_id = upload(app, PHOTOS - 1)
    look(app, capture_id)
    late = f"{PHOTOS - 1:03}.jpg"
    app.http.put(f"/v1/captures/{capture_id}/images/{late}", content=photo(PHOTOS - 1))
    other = serve(storage=s3.storage)
    of(s3, capture_id)
    assert look(other, capture_id) == EXPECTED
    assert [r.path.rpartition("/")[2] for r in of(s3, capture_id) if "sha256" in r.path] == [late]
    assert look(app, capture_id) == look(other, capture_id) == EXPECTED
    assert not [request for request in of(s3, capture_id) if "sha256" in request.path]


def test_a_capture_of_a_version_without_manifests_is_read_and_gets_one(
    s3: FaultyS3, app: ServedApp, serve: Serve
) -> None:
    storage, capture_id = app.service.storage, secrets.token_hex(8)
    record = {"id": capture_id, "created_at": "2026-01-02T03:04:05Z", "owner": "default", "format": 1}
    storage.put(layout.capture_record(capture_id), json.dumps(record).encode())
    for number in range(PHOTOS):
        name = f"{number:03}.jpg"
        storage.put(layout.capture_digest(capture_id, Role.images, name), EXPECTED[name].encode())
        storage.put(layout.capture_file(capture_id, Role.images, name), photo(number))
    storage.put(layout.capture_file(capture_id, Role.images, "no digest.jpg"), b"x")
    assert look(app, capture_id) == EXPECTED
    of(s3, capture_id)
    assert look(serve(storage=s3.storage), capture_id) == EXPECTED
    # Only the file that has none is asked for its digest again.
    assert len([request for request in of(s3, capture_id) if "sha256" in request.path]) == 1


@pytest.mark.parametrize(
    "damage",
    [
        b"not json",
        b"[]",
        b'{"format": 1}',
        b'{"format": 99, "created_at": "x", "files": {}}',
        b'{"format": 1, "created_at": "CREATED", "files": {"images/000.jpg": []}}',
        b'{"format": 1, "created_at": "CREATED", "files": {"images/000.jpg": ["%s", 7]}}' % (b"0" * 64),
        b'{"format": 1, "created_at": "2001-01-01T00:00:00+00:00", "files": {"images/000.jpg": ["%s", 11]}}'
        % (b"0" * 64),
    ],
)
def test_a_manifest_that_is_damaged_or_of_another_capture_is_not_believed(
    serve: Serve, damage: bytes
) -> None:
    app = serve()
    capture_id = upload(app, 3)
    created = app.service.captures.get(capture_id).created_at.isoformat()
    path = layout.capture_manifest(capture_id)
    app.service.storage.put(path, damage.replace(b"CREATED", created.encode()))
    assert look(serve(), capture_id) == {name: EXPECTED[name] for name in list(EXPECTED)[:3]}


def test_a_capture_with_the_id_of_a_deleted_one_shows_its_own_digests(
    serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The deletion happens in another process, so that this one still remembers what it stored."""
    app, other = serve(), serve()
    body = {"key": "digest of the photos"}

    def make(at: ServedApp, content: bytes) -> str:
        capture_id = str(at.http.post("/v1/captures", json=body).json()["id"])
        assert at.http.put(f"/v1/captures/{capture_id}/images/a.jpg", content=content).status_code == 201
        return capture_id

    before = make(app, b"before")
    look(app, before)
    make_manifest = app.service.storage.get(layout.capture_manifest(before))
    assert other.http.delete(f"/v1/captures/{before}").status_code == 204
    assert make(other, b"behind") == before
    # As a look that was under way during the deletion would leave it.
    app.service.storage.put(layout.capture_manifest(before), make_manifest)
    for at in (app, other):
        assert look(at, before) == {"a.jpg": hashlib.sha256(b"behind").hexdigest()}


def test_manifests_of_a_capture_that_grows_are_not_written_at_each_look(
    s3: FaultyS3, app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture_id = upload(app, 1)
    look(app, capture_id)
    path = layout.capture_manifest(capture_id)
    before = app.service.storage.get(path)
    for number in range(1, 4):
        app.http.put(f"/v1/captures/{capture_id}/images/{number:03}.jpg", content=photo(number))
        assert len(look(app, capture_id)) == number + 1
    assert app.service.storage.get(path) == before
    monkeypatch.setattr(digests, "_REWRITE_SECONDS", 0.0)
    look(app, capture_id)
    held: dict[str, Any] = json.loads(app.service.storage.get(path))["files"]
    assert len(held) == 4


def test_an_upload_whose_storage_fails_leaves_no_file_and_can_be_repeated(
    s3: FaultyS3, app: ServedApp
) -> None:
    capture_id = upload(app, 1)
    address = f"/v1/captures/{capture_id}/images/late.jpg"
    s3.fault = lambda request: 500 if request.method == "PUT" and "/files/" in request.path else None
    problem(app.http.put(address, content=b"bytes"), 503, "storage_unavailable")
    assert list(look(app, capture_id)) == ["000.jpg"]
    s3.fault = lambda _: None
    assert app.http.put(address, content=b"bytes").status_code == 201
    assert app.http.put(address, content=b"bytes").status_code == 200
    problem(app.http.put(address, content=b"other"), 409, "name_taken")


def test_of_many_uploads_at_once_into_a_bucket_exactly_one_wins(app: ServedApp) -> None:
    capture_id = upload(app, 0)
    # Of one block, and of several.
    bodies = [bytes([number]) * (9_000_000 if number % 2 else 300_000) for number in range(6)]
    with ThreadPoolExecutor(len(bodies)) as pool:
        address = f"/v1/captures/{capture_id}/images/a.jpg"
        codes = list(pool.map(lambda body: app.http.put(address, content=body).status_code, bodies))
    assert sorted(codes) == [201] + [409] * 5
    winner = bodies[codes.index(201)]
    assert app.service.storage.get(layout.capture_file(capture_id, Role.images, "a.jpg")) == winner
    assert look(app, capture_id) == {"a.jpg": hashlib.sha256(winner).hexdigest()}
