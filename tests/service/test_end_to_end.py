"""The true pipeline through the embedded service: photos of the built-in still life in, a model and its views out.

The photos come with their poses, so that the test stays short; how well cameras are recovered is proven in
tests/worker, and how good models get is measured by worker/bench.
"""

import io
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker import synthetic
from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import Camera
from tests.support.posed_sets import document
from tests.support.scenes.photos import psnr
from tests.support.up import Up
from tests.support.waiting import gone, wait_for

pytestmark = pytest.mark.slow

COUNT, WIDTH, HEIGHT = 10, 160, 120
SMALL = {"max_gaussians": 2000, "lpips": "off"}


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Camera]]:
    folder = tmp_path_factory.mktemp("photos")
    return folder, synthetic.capture(folder, COUNT, WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def true_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    up = Up(tmp_path_factory.mktemp("true") / "data")
    del up.environment["SPLATMILL_PIPELINE"]
    yield up.start()
    up.close()


def upload(up: Up, folder: Path) -> str:
    capture = str(up.http.post("/v1/captures", json={}).json()["id"])
    for path in sorted(folder.glob("*.jpg")):
        answer = up.http.put(f"/v1/captures/{capture}/images/{path.name}", content=path.read_bytes())
        assert answer.status_code == 201, answer.text
    return capture


def test_posed_photos_become_a_model_whose_views_match_them(
    true_service: Up, photos: tuple[Path, dict[str, Camera]]
) -> None:
    up, (folder, cameras) = true_service, photos
    capture = upload(up, folder)
    answer = up.http.put(f"/v1/captures/{capture}/poses/transforms.json", json=document(cameras))
    assert answer.status_code == 201, answer.text
    answer = up.http.post("/v1/jobs", json={"capture": capture, "options": {"steps": 150} | SMALL})
    job_id = answer.json()["id"]
    job = up.ended(job_id, 200)
    assert job["state"] == "succeeded", job["problem"]

    model = up.http.get(f"/v1/models/{job_id}").json()
    assert model["gaussians"] > 500
    report = up.http.get(f"/v1/jobs/{job_id}/report").json()
    assert report["curve"][-1]["psnr"] > 14
    assert report["curve"][-1]["psnr"] > report["curve"][0]["psnr"]

    held_out = [
        c for c in up.http.get(f"/v1/models/{job_id}/cameras").json()["cameras"] if c["split"] == "test"
    ]
    assert [camera["name"] for camera in held_out] == sorted(cameras)[::8]
    for camera in held_out:
        view = up.http.post(f"/v1/models/{job_id}/render", json={"camera": camera["camera"]})
        assert view.status_code == 200, view.text
        image = np.asarray(Image.open(io.BytesIO(view.content)))
        photo = np.asarray(Image.open(folder / camera["name"]).resize((image.shape[1], image.shape[0])))
        assert psnr(image, photo) == pytest.approx(camera["psnr"], abs=0.2)

    wish = {"seconds": 0.5, "fps": 8, "width": 64, "height": 48}
    video = up.http.post(f"/v1/models/{job_id}/orbit", json=wish)
    assert video.headers["content-type"] == "video/mp4"
    assert video.content[4:8] == b"ftyp"

    # From that model, filmed.
    further = SMALL | {"steps": 40, "start": job_id, "progress_video": "orbit"}
    answer = up.http.post("/v1/jobs", json={"capture": capture, "options": further})
    later_id = answer.json()["id"]
    later = up.ended(later_id, 200)
    assert later["state"] == "succeeded", later["problem"]
    assert later["plan"]["initial"] == "model"
    curve = up.http.get(f"/v1/jobs/{later_id}/report").json()["curve"]
    assert curve[0]["psnr"] > report["curve"][-1]["psnr"] - 1.5
    assert curve[0]["memory"] > 10**8
    film = up.http.get(f"/v1/models/{later_id}/files/progress.mp4")
    assert film.headers["content-type"] == "video/mp4"
    assert film.content[4:8] == b"ftyp"


def test_a_colmap_model_without_points_trains(
    true_service: Up, photos: tuple[Path, dict[str, Camera]]
) -> None:
    """COLMAP's own recipe for known poses: cameras.txt, images.txt, and an empty points3D.txt."""
    up, (folder, cameras) = true_service, photos
    capture = upload(up, folder)
    files = colmap_model(cameras) | {"points3D.txt": b""}
    for name, content in files.items():
        answer = up.http.put(f"/v1/captures/{capture}/poses/sparse/0/{name}", content=content)
        assert answer.status_code == 201, answer.text
    job_id = up.http.post("/v1/jobs", json={"capture": capture, "options": {"steps": 100} | SMALL}).json()[
        "id"
    ]
    job = up.ended(job_id, 200)
    assert job["state"] == "succeeded", job["problem"]
    report = up.http.get(f"/v1/jobs/{job_id}/report").json()
    assert report["sfm"]["sparse_points"] == 0
    assert "stereo_points" in report["sfm"], (
        "stereo is tried, as for transforms.json; these photos are too small for it"
    )
    assert report["curve"][-1]["psnr"] > 14


def colmap_model(cameras: dict[str, Camera]) -> dict[str, bytes]:
    """cameras.txt and images.txt of the given cameras."""
    one = next(iter(cameras.values()))
    images = []
    for number, (name, camera) in enumerate(cameras.items(), 1):
        x, y, z, w = pycolmap.Rotation3d(camera.viewmat[:3, :3]).quat
        t = " ".join(map(repr, camera.viewmat[:3, 3].tolist()))
        images.append(f"{number} {w} {x} {y} {z} {t} 1 {name}\n\n")
    intrinsics = f"{one.fx} {one.fy} {one.cx} {one.cy}"
    return {
        "cameras.txt": f"1 PINHOLE {one.width} {one.height} {intrinsics}\n".encode(),
        "images.txt": "".join(images).encode(),
    }


def test_cancel_during_reconstruction_takes_under_two_seconds(true_service: Up, tmp_path: Path) -> None:
    up = true_service
    synthetic.capture(tmp_path, 20, 320, 240, samples=1)  # seconds of work
    capture = upload(up, tmp_path)
    job_id = up.http.post("/v1/jobs", json={"capture": capture}).json()["id"]

    def inside() -> list[int]:
        progress = up.job(job_id)["progress"]
        busy = progress is not None and progress["stage"] not in ("images", "training")
        return [child.pid for child in up.tree() if child.ppid() == up.worker] if busy else []

    processes = wait_for(inside, 60)
    decoders = [child for child in up.tree() if "splatmill_worker.images.decoding.decoder" in child.cmdline()]
    assert decoders
    assert not {"REDIS_URL", "SPLATMILL_API_KEY"} & {name for child in decoders for name in child.environ()}
    began = time.monotonic()
    up.http.post(f"/v1/jobs/{job_id}/cancel")
    assert up.ended(job_id)["state"] == "cancelled"
    assert time.monotonic() - began < 2.0
    assert gone(processes)


def test_a_capture_that_cannot_become_a_scene_says_why(true_service: Up, tmp_path: Path) -> None:
    for name in ("a.jpg", "b.jpg"):
        Image.new("RGB", (200, 150), "grey").save(tmp_path / name)
    Image.new("RGB", (200, 150), "white").save(tmp_path / "b.jpg")
    capture = upload(true_service, tmp_path)
    job_id = true_service.http.post("/v1/jobs", json={"capture": capture}).json()["id"]
    job = true_service.ended(job_id, 100)
    assert job["state"] == "failed"
    assert job["attempt"] == 1, "what would fail again must not be tried again"
    assert job["problem"]["code"].startswith(("sfm_", "too_few"))
    assert job["problem"]["advice"]
