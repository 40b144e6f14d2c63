"""Uploads and downloads: bytes arrive whole or not at all, go on where they stopped, and one bad photo is one less.

Does not prove the server's side (idempotent PUT, Range); the tests against the real server do.
"""

import asyncio
import hashlib
import json
import random

import pytest

from splatmill import Client
from splatmill.errors import ConnectionFailed, DownloadFailed, InvalidRequest, NotFound, Unavailable
from splatmill.schema import SHA256_HEADER, Problem, Progress
from splatmill.transfer import uploads

DATA = random.Random(0).randbytes(300_000)
SHA256 = hashlib.sha256(DATA).hexdigest()
MODEL = json.dumps(
    {
        "id": "m1",
        "job": "m1",
        "created_at": "2026-01-01T00:00:00Z",
        "gaussians": 1,
        "bytes": 1,
        "sh_degree": 0,
    }
).encode()
CAPTURE = json.dumps({"id": "c1", "created_at": "2026-01-01T00:00:00Z"}).encode()


def ranged(request, reply, data=DATA, etag='"v1"', cut=0):
    """A file as a good server gives it."""
    headers = {"ETag": etag, SHA256_HEADER: hashlib.sha256(data).hexdigest()}
    span = request.headers.get("range")
    if span is None or request.headers.get("if-range") != etag:
        return reply(body=data, headers=headers, cut=cut)
    start = int(span.removeprefix("bytes=").removesuffix("-"))
    if start >= len(data):
        return reply(status=416)
    headers["Content-Range"] = f"bytes {start}-{len(data) - 1}/{len(data)}"
    return reply(status=206, body=data[start:], headers=headers, cut=min(cut, len(data) - start))


def serve(peer, reply, answer):
    peer.answer = lambda request: answer(request) if "/files/" in request.path else reply(body=MODEL)


def test_a_download_goes_on_where_it_broke(peer, reply, tmp_path):
    tries = []

    def answer(request):
        tries.append(request.headers.get("range"))
        return ranged(request, reply, cut=100_000 if len(tries) < 3 else 0)

    serve(peer, reply, answer)
    heard: list[tuple[int, int | None]] = []
    with Client(peer.url) as client:
        path = client.model("m1").download(tmp_path, on_bytes=lambda done, total: heard.append((done, total)))
    assert path == tmp_path / "model.ply"
    assert path.read_bytes() == DATA
    # The second try found 200,000 bytes and got none of the last 100,000, the third got them.
    assert tries == [None, "bytes=200000-", "bytes=200000-"]
    assert heard[-1] == (len(DATA), len(DATA))
    assert [p.name for p in tmp_path.iterdir()] == ["model.ply"]


def test_a_later_call_goes_on_with_what_an_earlier_one_left(peer, reply, tmp_path):
    target = tmp_path / "deep" / "model.ply"
    with Client(peer.url, retries=0) as client:
        serve(peer, reply, lambda request: ranged(request, reply, cut=50_000))
        model = client.model("m1")
        with pytest.raises(ConnectionFailed):
            model.download(target)
        assert not target.exists()
        serve(peer, reply, lambda request: ranged(request, reply))
        model.download(target)
    assert target.read_bytes() == DATA
    assert peer.requests[-1].headers["range"] == "bytes=250000-"


def test_another_version_of_the_file_is_begun_anew(peer, reply, tmp_path):
    target = tmp_path / "model.ply"
    other = b"the new one" * 1000
    with Client(peer.url, retries=0) as client:
        serve(peer, reply, lambda request: ranged(request, reply, cut=50_000))
        with pytest.raises(ConnectionFailed):
            client.model("m1").download(target)
        serve(peer, reply, lambda request: ranged(request, reply, other, '"v2"'))
        client.model("m1").download(target)
    assert target.read_bytes() == other


def test_a_part_that_was_whole_already_does_no_harm(peer, reply, tmp_path):
    (tmp_path / "model.ply.part").write_bytes(DATA)
    (tmp_path / "model.ply.part.etag").write_text('"v1"')
    serve(peer, reply, lambda request: ranged(request, reply))
    with Client(peer.url) as client:
        assert client.model("m1").download(tmp_path).read_bytes() == DATA


def test_other_bytes_than_promised_never_appear(peer, reply, tmp_path):
    target = tmp_path / "model.ply"
    target.write_bytes(b"the one from yesterday")
    serve(
        peer, reply, lambda _: reply(body=DATA[:-1] + bytes([DATA[-1] ^ 1]), headers={SHA256_HEADER: SHA256})
    )
    with Client(peer.url) as client, pytest.raises(DownloadFailed, match=SHA256[:12]):
        client.model("m1").download(target)
    assert target.read_bytes() == b"the one from yesterday"
    assert list(tmp_path.iterdir()) == [target]


def test_a_file_that_is_not_there(peer, reply, tmp_path):
    serve(peer, reply, lambda _: reply(status=404))
    with Client(peer.url) as client, pytest.raises(NotFound):
        client.model("m1").download(tmp_path, file="nothing.txt")
    assert list(tmp_path.iterdir()) == []


def photos(folder, count=9):
    for n in range(count):
        (folder / f"photo {n}.jpg").write_bytes(DATA[n * 1000 : n * 2000 + 1000])


def stored(request, reply):
    digest = hashlib.sha256(request.body).hexdigest()
    name = request.path.rsplit("/", 1)[1].replace("%20", " ")
    body = {"role": "images", "name": name, "size": len(request.body), "sha256": digest}
    return reply(status=201, body=json.dumps(body).encode())


def test_files_arrive_whole_with_their_digest(peer, reply, tmp_path):
    photos(tmp_path)
    lost = set()

    def answer(request):
        if request.method == "POST":
            return reply(status=201, body=CAPTURE)
        if request.path not in lost:  # every first try fails, one way or another
            lost.add(request.path)
            return reply(dropped=True) if len(lost) % 2 else reply(status=503)
        return stored(request, reply)

    peer.answer = answer
    heard: list[Progress] = []
    with Client(peer.url) as client:
        capture, uploaded = client.upload(tmp_path, on_progress=heard.append)
    assert capture.id == "c1"
    assert sorted(file.name for file in uploaded.files) == sorted(path.name for path in tmp_path.iterdir())
    for request in peer.requests[1:]:
        assert request.headers[SHA256_HEADER.lower()] == hashlib.sha256(request.body).hexdigest()
        assert request.headers["content-type"] == "image/jpeg"
    total = sum(path.stat().st_size for path in tmp_path.iterdir())
    assert [entry.done for entry in heard] == sorted(entry.done for entry in heard)
    assert (heard[-1].done, heard[-1].total) == (total, total)


def refusing(peer, reply, code, names):
    document = Problem.of(code, "It is not a photo.")

    def answer(request):
        if request.method == "POST":
            return reply(status=201, body=CAPTURE)
        if any(name in request.path for name in names):
            return reply(
                status=document.status,
                body=document.model_dump_json().encode(),
                headers={"Content-Type": "application/problem+json"},
            )
        return stored(request, reply)

    peer.answer = answer


def test_one_bad_photo_is_left_out_and_named(peer, reply, tmp_path):
    photos(tmp_path)
    refusing(peer, reply, "not_an_image", ["3.jpg"])
    with Client(peer.url) as client:
        _, uploaded = client.upload(tmp_path)
    assert [(name, problem.code) for name, problem in uploaded.refused] == [("photo 3.jpg", "not_an_image")]
    assert len(uploaded.files) == 8


def test_nothing_but_bad_photos_is_an_error(peer, reply, tmp_path):
    photos(tmp_path, 3)
    refusing(peer, reply, "not_an_image", [".jpg"])
    with Client(peer.url) as client, pytest.raises(InvalidRequest, match="not a photo"):
        client.upload(tmp_path)


def test_a_refusal_of_the_whole_ends_the_upload(peer, reply, tmp_path):
    photos(tmp_path)
    refusing(peer, reply, "body_too_large", ["photo"])
    with Client(peer.url) as client, pytest.raises(InvalidRequest) as error:
        client.upload(tmp_path)
    assert error.value.code == "body_too_large"
    assert len(peer.requests) < 9


def test_options_are_checked_before_anything_is_sent(peer, tmp_path):
    photos(tmp_path, 2)
    with Client(peer.url) as client, pytest.raises(InvalidRequest, match="there is no option 'stepps'"):
        client.train(tmp_path, stepps=3)  # type: ignore[call-arg]  # the error is what is tested
    assert peer.requests == []


def test_a_callback_that_fails_ends_the_upload(peer, reply, tmp_path):
    photos(tmp_path)
    refusing(peer, reply, "not_an_image", [])

    def fail(_: Progress) -> None:
        raise RuntimeError("enough")

    with Client(peer.url) as client, pytest.raises(RuntimeError, match="enough"):
        client.upload(tmp_path, on_progress=fail)


def test_a_file_that_the_capture_holds_is_not_sent_again(peer, reply, tmp_path):
    photos(tmp_path, 3)
    paths = sorted(tmp_path.iterdir())
    held = {"role": "images", "sha256": hashlib.sha256(paths[0].read_bytes()).hexdigest()}
    files = [held | {"name": paths[0].name, "size": paths[0].stat().st_size}]
    files += [held | {"name": paths[1].name, "size": paths[1].stat().st_size}]  # other bytes under this name
    capture = json.dumps(json.loads(CAPTURE) | {"files": files}).encode()
    peer.answer = lambda request: reply(body=capture) if request.method == "GET" else stored(request, reply)
    with Client(peer.url) as client:
        _, uploaded = client.upload(tmp_path, capture="c1")
    sent = [
        request.path.rsplit("/", 1)[-1].replace("%20", " ")
        for request in peer.requests
        if request.method == "PUT"
    ]
    assert sorted(sent) == [paths[1].name, paths[2].name]
    assert sorted(file.name for file in uploaded.files) == sorted(path.name for path in paths)


def test_a_slow_rendering_is_not_asked_for_again(peer, reply, tmp_path):
    too_slow = Problem.of("render_timeout", "The renderer did not answer within 120 seconds.")
    headers = {"Content-Type": "application/problem+json"}
    peer.answer = lambda request: (
        reply(body=MODEL)
        if request.method == "GET"
        else reply(status=504, body=too_slow.model_dump_json().encode(), headers=headers)
    )
    at = {"camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
    with Client(peer.url) as client:
        model = client.model("m1")
        with pytest.raises(Unavailable, match="120 seconds"):
            model.render(at | {"width": 64, "height": 48, "fov_y_deg": 50})
        with pytest.raises(Unavailable, match="120 seconds"):
            model.orbit(tmp_path, keep=False)
    assert [request.method for request in peer.requests] == ["GET", "POST", "POST"]


def test_an_orbit_is_waited_for_as_long_as_asked_and_asked_for_once(peer, reply, tmp_path):
    async def never(request):
        await asyncio.sleep(60)

    peer.answer = lambda request: reply(body=MODEL) if request.method == "GET" else never(request)
    with Client(peer.url) as client, pytest.raises(ConnectionFailed):
        client.model("m1").orbit(tmp_path, timeout=0.3, keep=False)
    assert [request.method for request in peer.requests] == ["GET", "POST"]


def test_a_version_that_no_header_can_hold_is_not_sent_back(peer, reply, tmp_path):
    tries = []

    def answer(request):
        tries.append(request.headers.get("range"))
        return ranged(request, reply, etag='"é"', cut=100_000 if len(tries) < 3 else 0)

    serve(peer, reply, answer)
    with Client(peer.url) as client:
        assert client.model("m1").download(tmp_path).read_bytes() == DATA
    assert tries == [None, None, None]  # without a version, the file is begun anew


@pytest.mark.parametrize("address", ["http://xn--/", "//evil.example/x", "https://evil.example/x", "/é"])
def test_an_upload_does_not_go_on_at_another_server(peer, reply, tmp_path, monkeypatch, address):
    monkeypatch.setattr(uploads, "PIECE", 1000)
    (tmp_path / "film.mp4").write_bytes(DATA)

    def answer(request):
        if request.method == "PUT":
            return reply(status=201, headers={"Location": address, "Upload-Offset": "0"})
        return reply(body=CAPTURE)

    peer.answer = answer
    with Client(peer.url, retries=0) as client, pytest.raises(ConnectionFailed, match="several requests"):
        client.upload(tmp_path / "film.mp4")
    assert {request.method for request in peer.requests} <= {"GET", "POST", "PUT", "DELETE"}
