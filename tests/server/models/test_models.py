"""Finished models over real HTTP: files with ranges and ETags, cameras, and what is refused.

Not proved here: that a model is good, and the pictures themselves (tests/worker/render_service).
"""

import hashlib
import json

import pytest

from splatmill.backplane.storage import layout
from splatmill.schema import CameraSpec, ModelCamera, ModelCameras
from splatmill.schema.headers import write_json
from tests.support.served_app import ServedApp, problem, store_model


@pytest.fixture
def model_id(app: ServedApp) -> str:
    job_id = app.job()
    app.begin(job_id)
    app.finish(job_id)
    return job_id


def test_a_model_says_what_it_is(app: ServedApp, model_id: str) -> None:
    model = app.http.get(f"/v1/models/{model_id}").json()
    ply = app.http.get(f"/v1/models/{model_id}/files/model.ply")
    assert (model["id"], model["gaussians"], model["sh_degree"], model["psnr"]) == (model_id, 2, 1, 27.5)
    assert model["bytes"] == len(ply.content)
    assert {f["name"] for f in model["files"]} == set(layout.MODEL_FILES) - {
        "cameras.zip",
        "frame.json",
        "poster.jpg",
        "report.png",
        "progress.mp4",
    }
    assert ply.headers["content-disposition"].startswith("attachment")
    assert [m["id"] for m in app.http.get("/v1/models").json()["models"]] == [model_id]
    assert app.http.get(f"/v1/models/{model_id}/cameras").json() == {"cameras": [], "up": None}
    assert app.http.get(f"/v1/jobs/{model_id}/report").json()["curve"][0]["psnr"] == 27.5
    assert app.http.get(f"/v1/jobs/{model_id}/preview").content == b"\xff\xd8\xff preview"


def test_many_cameras_are_sent_compressed_to_those_who_read_it(app: ServedApp, model_id: str) -> None:
    camera = CameraSpec.looking_at((0.1, 0.2, -3.0), (0.0, 0.0, 0.0), width=64, height=48)
    cameras = [ModelCamera(name=f"{number}.jpg", split="train", camera=camera) for number in range(100)]
    path = layout.model_file(model_id, "cameras.json")
    app.service.storage.put(path, write_json(ModelCameras(cameras=cameras)).encode())
    address = f"/v1/models/{model_id}/cameras"
    plain = app.http.get(address, headers={"Accept-Encoding": "identity"})
    packed = app.http.get(address, headers={"Accept-Encoding": "gzip"})
    assert "content-encoding" not in plain.headers
    assert packed.headers["content-encoding"] == "gzip"
    assert packed.json() == plain.json()
    assert len(packed.json()["cameras"]) == 100
    assert int(packed.headers["content-length"]) < int(plain.headers["content-length"]) / 4
    assert "content-encoding" not in app.http.get(f"/v1/models/{model_id}/files/cameras.json").headers


def test_a_file_can_be_read_in_parts_and_is_not_sent_twice(app: ServedApp, model_id: str) -> None:
    address = f"/v1/models/{model_id}/files/model.ply"
    whole = app.http.get(address)
    size, etag = len(whole.content), whole.headers["etag"]
    assert etag.startswith('"')

    def part(spec: str, **headers: str) -> tuple[int, bytes, str | None]:
        answer = app.http.get(address, headers={"Range": spec} | headers)
        return answer.status_code, answer.content, answer.headers.get("content-range")

    assert part("bytes=0-9") == (206, whole.content[:10], f"bytes 0-9/{size}")
    assert part("bytes=10-") == (206, whole.content[10:], f"bytes 10-{size - 1}/{size}")
    assert part("bytes=-7") == (206, whole.content[-7:], f"bytes {size - 7}-{size - 1}/{size}")
    assert part("bytes=5-999999") == (206, whole.content[5:], f"bytes 5-{size - 1}/{size}")
    # RFC 9110: several ranges and nonsense may be ignored, and If-Range with another ETag must be.
    for ignored in ("bytes=0-1,3-4", "bytes=9-2", "bytes=x", "pages=1-2", "bytes=-"):
        assert part(ignored) == (200, whole.content, None)
    assert part("bytes=0-9", **{"If-Range": '"other"'}) == (200, whole.content, None)
    assert part("bytes=0-9", **{"If-Range": etag})[0] == 206
    outside = app.http.get(address, headers={"Range": f"bytes={size}-"})
    problem(outside, 416, "range_not_satisfiable")
    assert outside.headers["content-range"] == f"bytes */{size}"
    for tag in (etag, f'"x", W/{etag}', "*"):
        answer = app.http.get(address, headers={"If-None-Match": tag})
        assert (answer.status_code, answer.content, answer.headers["etag"]) == (304, b"", etag)
    head = app.http.head(address)
    assert (head.status_code, head.headers["content-length"], head.content) == (200, str(size), b"")


def test_a_large_file_arrives_whole(app: ServedApp, model_id: str) -> None:
    body = hashlib.sha256(b"seed").digest() * 400_000  # 12.8 MB, many pieces
    app.service.storage.put(layout.model_file(model_id, "report.png"), body)
    assert app.http.get(f"/v1/models/{model_id}/files/report.png").content == body
    part = app.http.get(f"/v1/models/{model_id}/files/report.png", headers={"Range": "bytes=5000000-9999999"})
    assert part.content == body[5_000_000:10_000_000]


def test_pages_with_scripts_get_no_rights_on_our_origin(app: ServedApp, model_id: str) -> None:
    report = app.http.get(f"/v1/models/{model_id}/files/report.html")
    assert report.headers["content-type"].startswith("text/html")
    assert "sandbox" in report.headers["content-security-policy"]
    assert report.headers["x-content-type-options"] == "nosniff"


def test_unfinished_unknown_and_lost_models_are_told_apart(app: ServedApp) -> None:
    job_id = app.job()
    for tail in ("", "/files/model.ply", "/cameras"):
        problem(app.http.get(f"/v1/models/{job_id}{tail}"), 409, "model_not_ready")
    problem(app.http.get(f"/v1/jobs/{job_id}/report"), 404, "report_not_ready")
    problem(app.http.get(f"/v1/jobs/{job_id}/preview"), 404, "preview_not_ready")
    app.http.post(f"/v1/jobs/{job_id}/cancel")
    assert "cancelled" in problem(app.http.get(f"/v1/models/{job_id}"), 404, "model_not_found")["detail"]
    problem(app.http.get("/v1/models/0123456789abcdef"), 404, "model_not_found")
    problem(app.http.get("/v1/models/0123456789abcdef/files/model.ply"), 404, "model_not_found")


def test_only_a_models_own_files_are_served(app: ServedApp, model_id: str) -> None:
    app.service.storage.put(f"models/{model_id}/secret.txt", b"x")
    for name in ("secret.txt", "nothing.ply", "report.png"):
        problem(app.http.get(f"/v1/models/{model_id}/files/{name}"), 404, "file_not_found")
    problem(app.http.get(f"/v1/models/{model_id}/files/..%2fjob.json"), 404, "file_not_found")


def test_files_in_folders_are_listed_and_served(app: ServedApp, model_id: str) -> None:
    storage = app.service.storage
    for name in ("held_out/000.webp", "time_lapse/012.ply", "held_out/x.webp", "other/000.webp"):
        storage.put(f"models/{model_id}/{name}", name.encode())
    model = app.http.get(f"/v1/models/{model_id}").json()
    types = {f["name"]: f["media_type"] for f in model["files"] if "/" in f["name"]}
    assert types == {"held_out/000.webp": "image/webp", "time_lapse/012.ply": "application/octet-stream"}
    photo = app.http.get(f"/v1/models/{model_id}/files/held_out/000.webp")
    assert (photo.content, photo.headers["content-type"]) == (b"held_out/000.webp", "image/webp")
    for name in (
        "held_out/x.webp",
        "other/000.webp",
        "held_out/../job.json",
        "held_out/001.webp",
        "held_out",
    ):
        problem(
            app.http.get(f"/v1/models/{model_id}/files/{name.replace('..', '%2e%2e')}"), 404, "file_not_found"
        )
    app.http.delete(f"/v1/jobs/{model_id}")
    assert not list(storage.entries(f"models/{model_id}"))


def test_one_unreadable_model_does_not_hide_the_others(app: ServedApp, model_id: str) -> None:
    store_model(app.service, "b" * 16)
    app.service.storage.put(layout.model_file("b" * 16, "model.ply"), b"not a ply")
    problem(app.http.get("/v1/models/" + "b" * 16), 500, "model_corrupt")
    assert [m["id"] for m in app.http.get("/v1/models").json()["models"]] == [model_id]


def test_pages_of_models_hold_each_once(app: ServedApp) -> None:
    ids = [f"{i:016x}" for i in range(5)]
    for model_id in ids:
        store_model(app.service, model_id)
    all_ids, cursor = [], None
    while True:
        page = app.http.get("/v1/models", params={"limit": 2} | ({"cursor": cursor} if cursor else {})).json()
        all_ids += [m["id"] for m in page["models"]]
        if (cursor := page["cursor"]) is None:
            break
    assert sorted(all_ids) == ids


def test_files_have_the_digests_that_the_worker_stored(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.finish(job_id)
    path = layout.job_record(job_id)
    record = json.loads(app.service.storage.get(path))
    digest = hashlib.sha256(app.service.storage.get(layout.model_file(job_id, "model.ply"))).hexdigest()

    def digests() -> dict[str, str | None]:
        files = app.http.get(f"/v1/models/{job_id}").json()["files"]
        return {file["name"]: file["sha256"] for file in files}

    assert set(digests().values()) == {None}
    app.service.storage.put(
        path, json.dumps(record | {"sha256": {"model.ply": digest, "report.json": 7}}).encode()
    )
    assert {name: sha256 for name, sha256 in digests().items() if sha256} == {"model.ply": digest}
    app.service.storage.put(path, json.dumps(record | {"sha256": "x"}).encode())
    assert set(digests().values()) == {None}


def test_a_report_of_a_later_format_is_refused_by_name(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    app.finish(job_id)
    path = layout.model_file(job_id, "report.json")
    report = json.loads(app.service.storage.get(path)) | {"format": 2}
    app.service.storage.put(path, json.dumps(report).encode())
    refusal = problem(app.http.get(f"/v1/jobs/{job_id}/report"), 500, "model_corrupt")
    assert "it has format 2, and this version reads formats up to 1" in refusal["detail"]
    assert app.http.get(f"/v1/models/{job_id}").status_code == 200
