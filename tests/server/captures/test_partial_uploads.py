"""Uploads in several requests, over real HTTP, into a folder and into a bucket: they go on after every kind of break.

The bucket is moto's server. Not proved here: the behaviour of a bucket under load, and the SDK (tests/client).
"""

import hashlib
import os
import random
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.parts import EndMoved, open_part
from splatmill.backplane.storage.storage import Entry
from splatmill.schema import SHA256_HEADER, Role
from splatmill_server.base.problems import ProblemError
from splatmill_server.captures import unfinished_uploads
from tests.support.served_app import Serve, ServedApp, problem
from tests.support.servers.bucket import bucket
from tests.support.waiting import wait_for

DATA = random.Random(1).randbytes(3_000_001)
SHA256 = hashlib.sha256(DATA).hexdigest()
KNOWN = {"Upload-Length": str(len(DATA)), SHA256_HEADER: SHA256}


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    with bucket() as url:
        yield url


@pytest.fixture(params=["folder", "bucket"])
def app(request: pytest.FixtureRequest, serve: Serve) -> ServedApp:
    """The app, with storage in a folder and in a bucket."""
    if request.param == "folder":
        return serve()
    return serve(storage=f"{request.getfixturevalue('s3')}/{random.getrandbits(64):x}")


def capture(app: ServedApp) -> str:
    return str(app.http.post("/v1/captures", json={}).json()["id"])


def begin(app: ServedApp, capture_id: str, name: str = "images/a.mp4", **headers: str) -> httpx.Response:
    sent = {"Upload-Complete": "?0"} | (headers or KNOWN)
    return app.http.put(f"/v1/captures/{capture_id}/{name}", headers=sent)


def append(
    app: ServedApp,
    address: str,
    offset: int,
    body: object,
    complete: bool = False,
    headers: dict[str, str] | None = None,
) -> httpx.Response:
    sent = {
        "Upload-Offset": str(offset),
        "Upload-Complete": "?1" if complete else "?0",
        "Content-Type": "application/partial-upload",
    }
    return app.http.patch(address, headers=sent | (headers or {}), content=body)  # type: ignore[arg-type]  # bytes or iterator


def offset(app: ServedApp, address: str) -> int:
    answer = app.http.head(address)
    assert answer.status_code == 204
    assert answer.headers["cache-control"] == "no-store"
    return int(answer.headers["upload-offset"])


def held(app: ServedApp, address: str) -> int:
    """The bytes held, without a request: HEAD would end the one that brings them."""
    return open_part(app.service.storage, address.split("/")[3], address.split("/")[5]).offset()


def file_of(app: ServedApp, capture_id: str, name: str = "a.mp4") -> bytes:
    return app.service.storage.get(layout.capture_file(capture_id, Role.images, name))


def leftovers(app: ServedApp, capture_id: str) -> list[str]:
    """What storage holds of the capture beside its files and the records of complete uploads."""
    entries = app.service.storage.entries(layout.capture(capture_id))
    kept = ("capture.json", "manifest.json", "files", "sha256")
    paths = [entry.path.removeprefix(layout.capture(capture_id) + "/") for entry in entries]
    return [
        p for p in paths if p.split("/")[0] not in kept and not p.endswith(("/record.json", "/stored.json"))
    ]


def test_a_file_arrives_in_pieces_and_is_checked_as_a_whole(app: ServedApp) -> None:
    capture_id = capture(app)
    begun = begin(app, capture_id)
    assert begun.status_code == 201
    address = begun.headers["location"]
    assert begun.headers["upload-offset"] == "0"
    assert begun.headers["upload-complete"] == "?0"
    assert f"max-size={app.settings.max_file_bytes}" in begun.headers["upload-limit"]
    assert app.http.get(f"/v1/captures/{capture_id}").json()["files"] == []

    first = append(app, address, 0, DATA[:1_000_000])
    assert (first.status_code, first.headers["upload-offset"]) == (204, "1000000")
    assert first.headers["upload-complete"] == "?0"
    head = app.http.head(address).headers
    assert (head["upload-offset"], head["upload-length"], head["upload-complete"]) == (
        "1000000",
        str(len(DATA)),
        "?0",
    )
    # The same file is the same upload, for a client that has forgotten the address.
    again = begin(app, capture_id)
    assert again.headers["location"] == address
    assert again.headers["upload-offset"] == "1000000"

    assert append(app, address, 1_000_000, DATA[1_000_000:1_000_007]).status_code == 204
    last = append(app, address, 1_000_007, DATA[1_000_007:], complete=True)
    assert last.status_code == 201, last.text
    assert last.headers["upload-complete"] == "?1"
    assert last.json() == {"role": "images", "name": "a.mp4", "size": len(DATA), "sha256": SHA256}
    assert file_of(app, capture_id) == DATA
    assert app.http.get(f"/v1/captures/{capture_id}").json()["files"] == [last.json()]
    assert leftovers(app, capture_id) == []

    # A client that lost the last answer learns that all is done, and a repeated upload sends nothing.
    head = app.http.head(address).headers
    assert (head["upload-offset"], head["upload-complete"]) == (str(len(DATA)), "?1")
    problem(append(app, address, 1_000_007, DATA[1_000_007:], complete=True), 409, "upload_completed")
    repeat = begin(app, capture_id)
    assert (repeat.status_code, repeat.json()) == (200, last.json())
    assert repeat.headers["upload-complete"] == "?1"


def test_a_body_that_breaks_off_is_kept_as_far_as_it_came(app: ServedApp) -> None:
    capture_id = capture(app)
    address = begin(app, capture_id).headers["location"]
    with socket.create_connection(app.address, 10) as link:
        head = (
            f"PATCH {address} HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(DATA)}\r\nUpload-Offset: 0\r\n"
            "Upload-Complete: ?1\r\nContent-Type: application/partial-upload\r\n\r\n"
        )
        link.sendall(head.encode() + DATA[:2_000_000])
    wait_for(lambda: held(app, address) == 2_000_000)
    assert offset(app, address) == 2_000_000
    assert append(app, address, 2_000_000, DATA[2_000_000:], complete=True).status_code == 201
    assert file_of(app, capture_id) == DATA


def test_an_upload_goes_on_after_a_restart_of_the_server(app: ServedApp, serve: Serve) -> None:
    capture_id = capture(app)
    address = begin(app, capture_id).headers["location"]
    append(app, address, 0, DATA[:1_234_567])
    other = serve(storage=app.settings.storage)
    assert offset(other, address) == 1_234_567
    assert append(other, address, 1_234_567, DATA[1_234_567:], complete=True).status_code == 201
    assert file_of(other, capture_id) == DATA


def test_a_wrong_offset_is_answered_with_the_true_one(app: ServedApp) -> None:
    capture_id = capture(app)
    address = begin(app, capture_id).headers["location"]
    append(app, address, 0, DATA[:100])
    for wrong in (0, 99, 101, 5_000_000):
        answer = append(app, address, wrong, b"other bytes", complete=wrong == 99)
        refused = problem(answer, 409, "upload_offset_differs")
        assert answer.headers["upload-offset"] == "100"
        assert refused["facts"]["expected-offset"] == 100
        assert refused["facts"]["file"] == "images/a.mp4"
    assert append(app, address, 100, DATA[100:], complete=True).status_code == 201
    assert file_of(app, capture_id) == DATA


def test_a_later_request_takes_over_from_one_that_hangs(app: ServedApp) -> None:
    capture_id = capture(app)
    address = begin(app, capture_id).headers["location"]
    with socket.create_connection(app.address, 10) as hanging:
        head = (
            f"PATCH {address} HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(DATA)}\r\nUpload-Offset: 0\r\n"
            "Upload-Complete: ?1\r\nContent-Type: application/partial-upload\r\n\r\n"
        )
        hanging.sendall(head.encode() + DATA[:1_000_000])
        wait_for(lambda: app.service.partial_uploads._writers != {})
        at = offset(app, address)
        assert append(app, address, at, DATA[at:2_000_000]).status_code == 204
        # What the earlier request still brings is refused, and its connection learns why.
        hanging.sendall(b"\0" * (len(DATA) - 1_000_000))
        answer = _answer(hanging)
        assert b"409" in answer.split(b"\r\n")[0]
        assert b"upload_offset_differs" in answer
    assert append(app, address, 2_000_000, DATA[2_000_000:], complete=True).status_code == 201
    assert file_of(app, capture_id) == DATA


def test_two_captures_receive_the_same_file_at_once(app: ServedApp) -> None:
    addresses = [begin(app, capture(app)).headers["location"] for _ in range(2)]
    assert addresses[0].split("/")[5] == addresses[1].split("/")[5]  # the id follows from the file alone
    links = [socket.create_connection(app.address, 10) for _ in addresses]
    try:
        for address, link in zip(addresses, links, strict=True):
            head = (
                f"PATCH {address} HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(DATA)}\r\nUpload-Offset: 0\r\n"
                "Upload-Complete: ?1\r\nContent-Type: application/partial-upload\r\n\r\n"
            )
            link.sendall(head.encode() + DATA[:1_500_000])
        wait_for(lambda: len(app.service.partial_uploads._writers) == 2)
        # Neither the end of one upload nor its cancellation concerns the other one.
        links[1].sendall(DATA[1_500_000:])
        assert _answer(links[1]).startswith(b"HTTP/1.1 201")
        other = begin(app, capture(app)).headers["location"]
        assert offset(app, other) == 0
        assert app.http.delete(other).status_code == 204
        links[0].sendall(DATA[1_500_000:])
        assert _answer(links[0]).startswith(b"HTTP/1.1 201")
    finally:
        for link in links:
            link.close()
    assert [file_of(app, address.split("/")[3]) for address in addresses] == [DATA] * 2


def _answer(link: socket.socket) -> bytes:
    answer = b""
    while b"}" not in answer and (more := link.recv(65536)):
        answer += more
    return answer


def test_of_two_writers_at_the_same_offset_one_wins_and_bytes_are_never_mixed(
    app: ServedApp, serve: Serve
) -> None:
    """The two writers talk to two servers, which share the storage alone."""
    other = serve(storage=app.settings.storage)
    capture_id = capture(app)
    address = begin(app, capture_id, **{"Upload-Length": "2000000"}).headers["location"]
    gate = threading.Barrier(2)

    def write(server: ServedApp, letter: bytes) -> int:
        gate.wait()
        return append(server, address, 0, letter * 2_000_000, complete=True).status_code

    with ThreadPoolExecutor(2) as pool:
        codes = list(pool.map(write, (app, other), (b"a", b"b")))
    assert codes.count(201) <= 1
    if 201 in codes:
        assert file_of(app, capture_id) in (b"a" * 2_000_000, b"b" * 2_000_000)
    assert set(codes) <= {201, 404, 409}


def test_a_part_grows_at_its_end_only(app: ServedApp) -> None:
    storage = app.service.storage
    part = open_part(storage, "c" * 16, "u" * 16)
    other = open_part(storage, "c" * 16, "u" * 16)
    part.create()
    assert part.append(0, b"abc") == 3
    for wrong in (0, 2, 4) if storage.root is not None else (0,):
        with pytest.raises(EndMoved) as moved:
            other.append(wrong, b"xyz")
        assert moved.value.offset == 3
    assert other.append(3, b"def") == 6
    other.create()
    part.sync()
    assert part.offset() == 6
    assert b"".join(part.read()) == b"abcdef"


def test_other_bytes_than_announced_are_refused_at_the_end_and_leave_nothing(app: ServedApp) -> None:
    capture_id = capture(app)
    address = begin(app, capture_id).headers["location"]
    append(app, address, 0, b"\0" * 1_000_000)
    refused = append(app, address, 1_000_000, DATA[1_000_000:], complete=True)
    problem(refused, 422, "digest_mismatch")
    assert refused.headers["upload-complete"] == "?1"
    problem(append(app, address, len(DATA), b"", complete=True), 404, "upload_not_found")
    assert leftovers(app, capture_id) == []
    # The same upload can begin anew.
    address = begin(app, capture_id).headers["location"]
    assert append(app, address, 0, DATA, complete=True).status_code == 201


def test_lengths_that_do_not_agree_are_refused(app: ServedApp) -> None:
    capture_id = capture(app)
    address = begin(app, capture_id).headers["location"]
    too_long = append(app, address, 0, DATA + b"x", complete=True)
    problem(too_long, 400, "upload_length_differs")
    problem(append(app, address, 0, DATA[:-1], complete=True), 400, "upload_length_differs")
    differs = append(app, address, 0, b"x", headers={"Upload-Length": "7"})
    problem(differs, 400, "upload_length_differs")
    # Without an announced length of the body, it is found out while the body arrives.
    problem(append(app, address, 0, iter([DATA, b"more"])), 400, "upload_length_differs")
    at = offset(app, address)
    assert append(app, address, at, iter([DATA[at:]]), complete=True).status_code == 201
    assert file_of(app, capture_id) == DATA


def test_an_upload_without_a_digest_has_an_address_of_its_own(app: ServedApp) -> None:
    capture_id = capture(app)
    one = begin(app, capture_id, **{"Upload-Length": "5"}).headers["location"]
    two = begin(app, capture_id, **{"Upload-Length": "5"}).headers["location"]
    assert one != two
    assert append(app, one, 0, b"first", complete=True).status_code == 201
    late = append(app, two, 0, b"other", complete=True)
    problem(late, 409, "name_taken")
    assert late.headers["upload-complete"] == "?1"
    assert file_of(app, capture_id) == b"first"
    # The first bytes may come with the beginning, and the length with the end.
    headers = {"Upload-Complete": "?0"}
    begun = app.http.put(f"/v1/captures/{capture_id}/images/b.mp4", headers=headers, content=b"be")
    assert (begun.status_code, begun.headers["upload-offset"]) == (201, "2")
    assert append(app, begun.headers["location"], 2, b"gun", complete=True).status_code == 201
    assert file_of(app, capture_id, "b.mp4") == b"begun"


def test_an_upload_is_cancelled(app: ServedApp) -> None:
    capture_id = capture(app)
    address = begin(app, capture_id).headers["location"]
    append(app, address, 0, DATA[:500])
    assert app.http.delete(address).status_code == 204
    assert app.http.head(address).status_code == 404
    problem(append(app, address, 500, DATA[500:]), 404, "upload_not_found")
    problem(app.http.delete(address), 404, "upload_not_found")
    assert leftovers(app, capture_id) == []


def test_a_capture_that_is_deleted_meanwhile_keeps_nothing(app: ServedApp) -> None:
    capture_id = capture(app)
    address = begin(app, capture_id).headers["location"]

    def body() -> Iterator[bytes]:
        yield DATA[:1_500_000]
        assert app.http.delete(f"/v1/captures/{capture_id}").status_code == 204
        yield DATA[1_500_000:]

    problem(append(app, address, 0, body(), complete=True), 404, "capture_not_found")
    assert list(app.service.storage.entries(layout.capture(capture_id))) == []


def test_requests_that_are_not_understood_are_named(serve: Serve) -> None:
    app = serve()
    capture_id = capture(app)
    address = begin(app, capture_id).headers["location"]
    wrong_type = append(app, address, 0, b"x", headers={"Content-Type": "application/octet-stream"})
    problem(wrong_type, 415, "unsupported_media_type")
    for header, value in (("Upload-Offset", "zero"), ("Upload-Offset", "-1"), ("Upload-Complete", "yes")):
        problem(append(app, address, 0, b"x", headers={header: value}), 422, "invalid_request")
    problem(begin(app, capture_id, "images/%2e%2e/a", **KNOWN), 422, "name_invalid")
    assert app.http.head(f"/v1/captures/{capture_id}/uploads/nothing").status_code == 404
    options = app.http.options(f"/v1/captures/{capture_id}/images/a.mp4")
    assert options.headers["accept-patch"] == "application/partial-upload"
    assert "max-size=" in options.headers["upload-limit"]
    assert app.http.delete(f"/v1/captures/{capture_id}").status_code == 204
    problem(app.http.options(f"/v1/captures/{capture_id}/images/a.mp4"), 404, "capture_not_found")


def test_a_taken_name_is_refused_before_a_byte_is_sent(serve: Serve) -> None:
    app = serve()
    capture_id = capture(app)
    assert app.http.put(f"/v1/captures/{capture_id}/images/a.mp4", content=b"there").status_code == 201
    refused = problem(begin(app, capture_id), 409, "name_taken")
    assert refused["facts"]["stored_sha256"] == hashlib.sha256(b"there").hexdigest()


def test_the_limits_hold_from_the_first_request(serve: Serve) -> None:
    app = serve(max_file_bytes=1000)
    capture_id = capture(app)
    refused = begin(app, capture_id, **{"Upload-Length": "1001"})
    problem(refused, 413, "body_too_large")
    assert "max-size=1000" in refused.headers["upload-limit"]
    # Without an announced length, the limit holds while the bytes arrive.
    address = begin(app, capture_id, **{"Upload-Complete": "?0"}).headers["location"]
    assert append(app, address, 0, b"x" * 600).status_code == 204
    problem(append(app, address, 600, iter([b"x" * 300, b"x" * 300])), 413, "body_too_large")
    assert offset(app, address) == 600
    # An empty file has no boundaries.
    empty = begin(app, capture_id, "images/empty.jpg", **{"Upload-Length": "0"}).headers["location"]
    problem(append(app, empty, 0, b"", complete=True), 422, "file_empty")


def test_the_disk_must_have_room_for_the_whole_file(
    serve: Serve, tmp_path_factory: pytest.TempPathFactory
) -> None:
    app = serve()
    capture_id = capture(app)
    free = shutil.disk_usage(app.settings.data).free
    app.settings.min_free_bytes = free - 100_000_000
    problem(begin(app, capture_id, **{"Upload-Length": "500000000"}), 507, "storage_full")
    assert begin(app, capture_id, **{"Upload-Length": "1000"}).status_code == 201


def test_uploads_that_nobody_goes_on_with_are_swept_as_a_whole(serve: Serve) -> None:
    app = serve()
    capture_id = capture(app)
    root = app.service.storage.root
    assert root is not None
    old = begin(app, capture_id, "images/old.mp4", **KNOWN).headers["location"]
    slow = begin(app, capture_id, "images/slow.mp4", **KNOWN).headers["location"]
    for address in (old, slow):
        append(app, address, 0, DATA[:1000])
        folder = root / layout.upload(capture_id, address.rsplit("/", 1)[-1])
        for path in folder.iterdir():
            os.utime(path, (time.time() - 2 * 86400,) * 2)
    append(app, slow, 1000, DATA[1000:2000])
    assert app.service.captures.delete_abandoned_uploads() == 2
    assert app.http.head(old).status_code == 404
    assert offset(app, slow) == 2000


def test_counting_the_uploads_of_one_capture_holds_up_no_other(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unfinished_uploads, "MAX_UNFINISHED", 2)
    full, other = capture(app), capture(app)
    unsized = {"Upload-Complete": "?0"}
    assert [begin(app, full, **unsized).status_code for _ in range(2)] == [201, 201]
    counting, proceed = threading.Event(), threading.Event()

    storage = app.service.storage
    entries = storage.entries

    def slow_entries(prefix: str) -> Iterator[Entry]:
        if full in prefix:
            counting.set()
            proceed.wait(30)
        return entries(prefix)

    monkeypatch.setattr(storage, "entries", slow_entries)
    counted = unfinished_uploads.UnfinishedUploads(storage)

    def one_more(capture_id: str) -> None:
        with counted.one_more(capture_id, "a" * 16):
            pass

    with ThreadPoolExecutor(2) as pool:
        slow = pool.submit(one_more, full)
        try:
            assert counting.wait(10)
            pool.submit(one_more, other).result(timeout=60)
            assert not slow.done()
        finally:
            proceed.set()
        with pytest.raises(ProblemError, match="2 uploads that are not complete"):
            slow.result(timeout=60)


def test_a_capture_has_a_limited_number_of_unfinished_uploads(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unfinished_uploads, "MAX_UNFINISHED", 6)
    one, other = capture(app), capture(app)
    unsized = {"Upload-Complete": "?0"}  # without length and digest, each request begins another upload
    with ThreadPoolExecutor(16) as pool:
        answers = list(pool.map(lambda _: begin(app, one, **unsized), range(31)))
    begun = [answer.headers["location"] for answer in answers if answer.status_code == 201]
    assert len(begun) == 6
    for answer in answers:
        if answer.status_code != 201:
            assert problem(answer, 429, "too_many_requests")["facts"]["limit"] == 6
    assert len(app.service.storage.children(layout.capture_uploads(one))) == 6
    assert begin(app, other, **unsized).status_code == 201
    # One that is complete, and one that is cancelled, make room for two.
    assert append(app, begun[0], 0, b"whole", complete=True).status_code == 201
    assert append(app, begun[0], 0, b"whole", complete=True).json()["code"] == "upload_completed"
    assert app.http.delete(begun[1]).status_code == 204
    more = [begin(app, one, f"images/{n}.mp4", **unsized).status_code for n in range(3)]
    assert more == [201, 201, 429]
