"""Captures over real HTTP into a real folder: names, digests, limits, and what is left after each refusal.

Not proved here: a bucket as storage (test_digests), and what a worker makes of the files.
"""

import hashlib
import os
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path
from urllib.parse import quote

import httpx
import pytest

from splatmill.backplane.storage import layout
from splatmill.schema import Role
from splatmill_server.captures import records
from tests.support.served_app import Serve, ServedApp, problem, raw, stored
from tests.support.waiting import wait_for

PHOTO = b"\xff\xd8\xff a photo"


def test_a_capture_is_made_listed_read_and_deleted(app: ServedApp) -> None:
    made = app.http.post("/v1/captures", json={"name": "fox"})
    assert made.status_code == 201
    capture_id = made.json()["id"]
    assert made.headers["location"] == f"/v1/captures/{capture_id}"
    put = app.http.put(f"/v1/captures/{capture_id}/images/day 1/ü.jpg", content=PHOTO)
    assert put.status_code == 201
    assert put.json() == {
        "role": "images",
        "name": "day 1/ü.jpg",
        "size": len(PHOTO),
        "sha256": hashlib.sha256(PHOTO).hexdigest(),
    }
    assert app.http.get(f"/v1/captures/{capture_id}").json()["files"] == [put.json()]
    assert [c["id"] for c in app.http.get("/v1/captures").json()["captures"]] == [capture_id]
    assert app.http.delete(f"/v1/captures/{capture_id}").status_code == 204
    assert stored(app) == []
    problem(app.http.get(f"/v1/captures/{capture_id}"), 404, "capture_not_found")


def test_pages_of_captures_hold_each_once_newest_first(app: ServedApp) -> None:
    made = [app.http.post("/v1/captures", json={}).json() for _ in range(5)]
    ids, cursor = [], None
    while True:
        params = {"limit": "2"} | ({"cursor": cursor} if cursor else {})
        page = app.http.get("/v1/captures", params=params).json()
        ids += [capture["id"] for capture in page["captures"]]
        cursor = page["cursor"]
        if cursor is None:
            break
    newest = sorted(made, key=lambda c: (int(_ms(c["created_at"])), c["id"]), reverse=True)
    assert ids == [capture["id"] for capture in newest]
    problem(app.http.get("/v1/captures?cursor=nonsense"), 422, "cursor_invalid")


def _ms(moment: str) -> float:
    return datetime.fromisoformat(moment).timestamp() * 1000


def test_the_same_bytes_again_are_200_and_other_bytes_409_and_lose_nothing(app: ServedApp) -> None:
    capture_id = app.http.post("/v1/captures", json={}).json()["id"]
    address = f"/v1/captures/{capture_id}/images/a.jpg"
    assert app.http.put(address, content=PHOTO).status_code == 201
    assert app.http.put(address, content=PHOTO).status_code == 200
    before = stored(app)
    refused = problem(app.http.put(address, content=b"other"), 409, "name_taken")
    assert refused["facts"]["stored_sha256"] == hashlib.sha256(PHOTO).hexdigest()
    assert stored(app) == before
    assert app.service.storage.get(layout.capture_file(capture_id, Role.images, "a.jpg")) == PHOTO
    # The two Unicode spellings of one name are one name.
    assert app.http.put(f"/v1/captures/{capture_id}/images/e\u0301.jpg", content=PHOTO).status_code == 201
    assert app.http.put(f"/v1/captures/{capture_id}/images/\u00e9.jpg", content=PHOTO).status_code == 200


def test_of_many_uploads_at_once_under_one_name_exactly_one_wins(app: ServedApp) -> None:
    capture_id = app.http.post("/v1/captures", json={}).json()["id"]
    bodies = [b"%d" % i * 300_000 for i in range(8)]
    gate = threading.Barrier(len(bodies))

    def put(body: bytes) -> int:
        gate.wait()
        return app.http.put(f"/v1/captures/{capture_id}/images/a.jpg", content=body).status_code

    with ThreadPoolExecutor(len(bodies)) as pool:
        codes = list(pool.map(put, bodies))
    assert sorted(codes) == [201] + [409] * 7
    winner = bodies[codes.index(201)]
    assert app.service.storage.get(layout.capture_file(capture_id, Role.images, "a.jpg")) == winner
    assert not any("incoming" in path for path in stored(app))


@pytest.mark.parametrize(
    "name",
    [
        "../escape.jpg",
        "a/../../b.jpg",
        "/etc/passwd",
        "a//b.jpg",
        "a\\b.jpg",
        "a/./b.jpg",
        "x\x07.jpg",
        "x#1",
        "C:x",
    ],
)
def test_names_that_lead_elsewhere_are_refused(app: ServedApp, name: str) -> None:
    capture_id = app.http.post("/v1/captures", json={}).json()["id"]
    before = stored(app)
    # By hand, because httpx would resolve the dots before sending.
    status, body = raw(app, f"PUT /v1/captures/{capture_id}/images/{quote(name, safe='')} HTTP/1.1", PHOTO)
    assert status == 422, body
    assert b'"name_invalid"' in body
    assert stored(app) == before


def test_a_body_that_breaks_off_leaves_nothing_and_the_next_try_works(app: ServedApp) -> None:
    capture_id = app.http.post("/v1/captures", json={}).json()["id"]
    before = stored(app)
    for sent in (0, 10, 3_000_000):
        with socket.create_connection(app.address, 10) as link:
            head = f"PUT /v1/captures/{capture_id}/images/a.jpg HTTP/1.1\r\nHost: t\r\nContent-Length: 5000000\r\n\r\n"
            link.sendall(head.encode() + b"x" * sent)
        wait_for(lambda: stored(app) == before and not incoming(app))
    whole = b"x" * 5_000_000
    assert app.http.put(f"/v1/captures/{capture_id}/images/a.jpg", content=whole).status_code == 201


def incoming(app: ServedApp) -> list[Path]:
    root = app.service.storage.root
    assert root is not None
    return [path for path in root.rglob("*") if path.is_file() and "incoming" in path.parts]


def test_what_does_not_fit_its_digest_is_empty_or_too_large_is_refused(serve: Serve) -> None:
    app = serve(max_file_bytes=1000, max_files_per_capture=2)
    capture_id = app.http.post("/v1/captures", json={}).json()["id"]
    address = f"/v1/captures/{capture_id}/images/a.jpg"
    before = stored(app)
    wrong = {"X-Content-SHA256": "0" * 64}
    problem(app.http.put(address, content=PHOTO, headers=wrong), 422, "digest_mismatch")
    problem(app.http.put(address, content=b""), 422, "file_empty")
    problem(app.http.put(address, content=b"x" * 1001), 413, "body_too_large")
    # Without an announced length the limit holds as well.
    problem(app.http.put(address, content=iter([b"x" * 600, b"x" * 600])), 413, "body_too_large")
    problem(
        app.http.put(address, content=PHOTO, headers={"Content-Type": "text/html"}),
        415,
        "unsupported_media_type",
    )
    assert stored(app) == before
    right = {"X-Content-SHA256": hashlib.sha256(PHOTO).hexdigest().upper()}
    assert app.http.put(address, content=PHOTO, headers=right).status_code == 201
    assert app.http.put(f"/v1/captures/{capture_id}/masks/a.png", content=PHOTO).status_code == 201
    problem(app.http.put(f"/v1/captures/{capture_id}/images/c.jpg", content=PHOTO), 413, "body_too_large")


def test_only_the_points_of_a_colmap_model_may_be_empty(app: ServedApp) -> None:
    capture_id = app.http.post("/v1/captures", json={}).json()["id"]
    base = f"/v1/captures/{capture_id}"
    empty = hashlib.sha256(b"").hexdigest()
    for name in ("points3D.txt", "sparse/0/points3D.txt", "sparse/0/points3D.bin"):
        for status in (201, 200):
            answer = app.http.put(f"{base}/poses/{name}", content=b"")
            assert answer.status_code == status, answer.text
            assert answer.json() == {"role": "poses", "name": name, "size": 0, "sha256": empty}
    assert len(app.http.get(base).json()["files"]) == 3
    before = stored(app)
    for name in ("images/points3D.txt", "poses/images.txt", "poses/points3D.txt.bak", "masks/a.png"):
        refused = problem(app.http.put(f"{base}/{name}", content=b""), 422, "file_empty")
        assert name in refused["detail"]
    wrong = {"X-Content-SHA256": "0" * 64}
    problem(app.http.put(f"{base}/poses/b/points3D.txt", content=b"", headers=wrong), 422, "digest_mismatch")
    assert stored(app) == before


def test_unknown_captures_and_roles_are_named(app: ServedApp) -> None:
    problem(
        app.http.put("/v1/captures/0123456789abcdef/images/a.jpg", content=PHOTO), 404, "capture_not_found"
    )
    problem(app.http.get("/v1/captures/..%2f..%2fetc"), 405, "method_not_allowed")
    problem(app.http.get("/v1/captures/NOT-AN-ID"), 404, "capture_not_found")
    capture_id = app.capture()
    problem(app.http.put(f"/v1/captures/{capture_id}/videos/a.mp4", content=PHOTO), 422, "invalid_request")


def test_a_capture_that_a_job_uses_cannot_be_deleted(app: ServedApp) -> None:
    capture_id = app.capture()
    job_id = app.job(capture_id)
    refused = problem(app.http.delete(f"/v1/captures/{capture_id}"), 409, "capture_in_use")
    assert refused["facts"] == {"job": job_id}
    app.http.post(f"/v1/jobs/{job_id}/cancel")
    assert app.http.delete(f"/v1/captures/{capture_id}").status_code == 204


@pytest.mark.parametrize("pieces", [False, True])
def test_the_reserve_of_the_disk_is_kept_while_a_file_arrives(app: ServedApp, pieces: bool) -> None:
    """Of files that come at once, each finds the same room before its first byte; here the room goes later."""
    capture_id = app.http.post("/v1/captures", json={}).json()["id"]

    def body() -> Iterator[bytes]:
        yield b"a" * records.DISK_STEP
        app.settings.min_free_bytes = 1 << 60
        for _ in range(4):
            yield b"b" * records.DISK_STEP

    headers = {"Upload-Complete": "?0"} if pieces else {}
    answer = app.http.put(f"/v1/captures/{capture_id}/images/a.mp4", content=body(), headers=headers)
    assert "reserve" in problem(answer, 507, "storage_full")["detail"]
    app.settings.min_free_bytes = 0
    assert app.http.get(f"/v1/captures/{capture_id}").json()["files"] == []
    root = app.service.storage.root
    assert root is not None
    held = sum((root / name).stat().st_size for name in stored(app))
    assert held < (2 * records.DISK_STEP if pieces else 10_000)


def test_a_disk_without_room_for_it_refuses_an_upload(serve: Serve) -> None:
    app = serve(min_free_bytes=1 << 60)
    capture_id = app.http.post("/v1/captures", json={}).json()["id"]
    refused = problem(
        app.http.put(f"/v1/captures/{capture_id}/images/a.jpg", content=PHOTO), 507, "storage_full"
    )
    assert refused["facts"]["free"] > 0
    assert app.http.get(f"/v1/captures/{capture_id}").json()["files"] == []


def test_what_a_killed_server_left_of_an_upload_is_removed_by_the_next(serve: Serve) -> None:
    first = serve()
    capture_id = first.capture()
    before = stored(first)
    root = first.service.storage.root
    assert root is not None
    folder = root / layout.capture_incoming(capture_id)
    folder.mkdir(parents=True, exist_ok=True)
    for name, age in (("old", 2 * 86400), ("old#1", 2 * 86400), ("new#1", 60)):
        (folder / name).write_bytes(b"half an upload")
        os.utime(folder / name, (time.time() - age,) * 2)
    again = serve()
    again.service.sweeper.search()
    assert set(stored(again)) - set(before) == {f"{layout.capture_incoming(capture_id)}/new#1"}


def test_an_upload_into_a_capture_that_is_deleted_meanwhile_leaves_nothing(app: ServedApp) -> None:
    capture_id = app.capture()

    def body() -> Iterator[bytes]:
        yield b"x" * 300_000
        assert app.http.delete(f"/v1/captures/{capture_id}").status_code == 204
        yield b"y" * 300_000

    answer = app.http.put(f"/v1/captures/{capture_id}/images/late.jpg", content=body())
    problem(answer, 404, "capture_not_found")
    assert stored(app) == []


def test_every_error_of_an_upload_names_its_file(serve: Serve, tmp_path: Path) -> None:
    app = serve(max_file_bytes=1000, max_files_per_capture=2)
    capture_id = app.http.post("/v1/captures", json={}).json()["id"]
    address = f"/v1/captures/{capture_id}/images/sub/a.jpg"
    assert app.http.put(address, content=PHOTO).status_code == 201
    wrong = {"X-Content-SHA256": "0" * 64}

    def named(answer: httpx.Response, status: int, code: str, name: str) -> None:
        refusal = problem(answer, status, code)
        assert name in refusal["detail"]
        assert refusal["facts"]["file"] == name

    named(app.http.put(address, content=b"other"), 409, "name_taken", "images/sub/a.jpg")
    empty = address.replace("images/sub/a.jpg", "poses/images.txt")
    named(app.http.put(empty, content=b""), 422, "file_empty", "poses/images.txt")
    named(app.http.put(empty, content=b"x" * 2000), 413, "body_too_large", "poses/images.txt")
    named(app.http.put(empty, content=b"x", headers=wrong), 422, "digest_mismatch", "poses/images.txt")
    gone = "/v1/captures/0123456789abcdef/images/a.jpg"
    named(app.http.put(gone, content=PHOTO), 404, "capture_not_found", "images/a.jpg")
    refused = app.http.put(address, content=PHOTO, headers={"Content-Type": "text/html"})
    assert "images/sub/a.jpg" in problem(refused, 415, "unsupported_media_type")["detail"]
    assert app.http.put(address.replace("a.jpg", "b.jpg"), content=PHOTO).status_code == 201
    named(
        app.http.put(address.replace("a.jpg", "c.jpg"), content=PHOTO),
        413,
        "body_too_large",
        "images/sub/c.jpg",
    )

    # In a form of many files, only the name shows which one was refused.
    files = [("images", ("a.jpg", PHOTO)), ("masks", ("b.png", b"")), ("images", ("c.jpg", PHOTO))]
    named(app.http.post("/v1/jobs", files=files), 422, "file_empty", "masks/b.png")

    # So it does where storage fails.
    other = app.http.post("/v1/captures", json={}).json()["id"]
    (tmp_path / "data" / "storage" / "captures" / other / "sha256").write_text("in the way")
    answer = app.http.put(f"/v1/captures/{other}/images/d.jpg", content=PHOTO)
    named(answer, 503, "storage_unavailable", "images/d.jpg")


def test_requests_with_the_same_key_get_the_same_capture(app: ServedApp) -> None:
    body = {"name": "fox", "key": "digest of the photos"}
    made = app.http.post("/v1/captures", json=body)
    assert made.status_code == 201
    address = made.headers["location"]
    assert app.http.put(f"{address}/images/a.jpg", content=PHOTO).status_code == 201
    again = app.http.post("/v1/captures", json=body | {"name": "another name"})
    assert (again.status_code, again.headers["location"]) == (200, address)
    assert [file["name"] for file in again.json()["files"]] == ["a.jpg"]
    assert again.json()["name"] == "fox"
    other = app.http.post("/v1/captures", json={"key": "another digest"})
    assert other.status_code == 201
    assert other.json()["id"] != made.json()["id"]
    # After the capture was deleted, the key begins a new one.
    assert app.http.delete(address).status_code == 204
    anew = app.http.post("/v1/captures", json=body)
    assert (anew.status_code, anew.json()["files"]) == (201, [])
    problem(app.http.post("/v1/captures", json={"key": ""}), 422, "invalid_request")
    gate = threading.Barrier(6)

    def create(_: int) -> tuple[int, str]:
        gate.wait()
        answer = app.http.post("/v1/captures", json={"key": "at once"})
        return answer.status_code, answer.json()["id"]

    with ThreadPoolExecutor(6) as pool:
        answers = list(pool.map(create, range(6)))
    assert sorted(code for code, _ in answers) == [200] * 5 + [201]
    assert len({capture_id for _, capture_id in answers}) == 1


def test_a_key_gives_no_capture_that_is_being_deleted(app: ServedApp) -> None:
    """Its files are deleted after its record, one by one; a file that was uploaded again would be deleted with them."""
    body = {"key": "digest of the photos"}
    first = app.http.post("/v1/captures", json=body).json()["id"]
    assert app.http.put(f"/v1/captures/{first}/images/a.jpg", content=PHOTO).status_code == 201
    app.service.storage.delete(layout.capture_record(first))
    second = app.http.post("/v1/captures", json=body)
    assert second.status_code == 201
    assert second.json()["id"] != first
    app.service.storage.delete_prefix(layout.capture(first))
    again = app.http.post("/v1/captures", json=body)
    assert (again.status_code, again.json()["id"]) == (200, second.json()["id"])


def test_files_of_a_deleted_capture_do_not_count_for_one_with_its_id(
    serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(records, "_RECENT_SECONDS", 0.0)
    first, second = (serve(max_files_per_capture=1) for _ in range(2))
    key = {"key": "once"}
    made = [first.http.post("/v1/captures", json=key).json()["id"]]
    assert second.http.put(f"/v1/captures/{made[0]}/images/a.jpg", content=b"a").status_code == 201
    problem(second.http.put(f"/v1/captures/{made[0]}/images/b.jpg", content=b"b"), 413, "body_too_large")
    assert first.http.delete(f"/v1/captures/{made[0]}").status_code == 204
    made.append(first.http.post("/v1/captures", json=key).json()["id"])
    assert made[0] == made[1]
    assert second.http.put(f"/v1/captures/{made[1]}/images/a.jpg", content=b"a").status_code == 201
