"""Proves that `splatmill train` makes as good a scene of panoramas with cameras as of pinhole photos that cover the
same directions, within 1 dB, and that its files name the faces and hold out whole panoramas.

The pinhole photos are those that the ray caster renders at the places of the faces; both models are compared with those
at held-out places. Both start from the same points, as such small photos have few features. Not proven: how panoramas
train whose cameras are recovered; tests/worker/sfm/test_panoramas.py has their cameras.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatmill_worker.images.lens import PANORAMA
from splatmill_worker.images.panoramas import faces
from splatmill_worker.scene import Camera, Float, Lens, View
from splatmill_worker.sfm.posed.transforms import OPENGL_TO_OPENCV
from splatmill_worker.splat.formats import registry
from splatmill_worker.splat.render import render
from splatmill_worker.synthetic.ray_caster import photograph
from tests.support import panoramas
from tests.support.command_line import spawn

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

COUNT, WIDTH = 10, 256
COLORS = ("red", "green", "blue")
HELD_OUT = (0, 8)
"""Panoramas of ten in order that `splatmill train` holds out."""


def frame(name: str, viewmat: Float, **intrinsics: Any) -> dict[str, Any]:
    matrix = np.linalg.inv(viewmat) @ OPENGL_TO_OPENCV
    return {"file_path": f"images/{name}", "transform_matrix": matrix.tolist(), **intrinsics}


def trained(capture: Path, frames: list[dict[str, Any]], **lists: Any) -> Path:
    document = {"frames": frames, "ply_file_path": "points.ply", **lists}
    (capture / "transforms.json").write_text(json.dumps(document))
    out = capture / "out"
    options = ("--steps", "200", "--backend", "cpu", "--time-lapse", "off", "--lpips", "off")
    process = spawn("train", capture, "-o", out, *options)
    said = process.communicate(timeout=600)
    assert process.returncode == 0, said
    return out


def psnr(out: Path, cameras: list[Camera], photos: list[np.ndarray]) -> float:
    """Mean PSNR of a model at these cameras in its own world."""
    gaussians = registry.read(out / "model.ply").gaussians
    errors = [
        np.square(render(gaussians, camera).color.clamp(0, 1).numpy() - photo / 255).mean()
        for camera, photo in zip(cameras, photos, strict=True)
    ]
    return float(np.mean(-10 * np.log10(errors)))


def test_panoramas_train_as_well_as_pinhole_photos_of_the_same_directions(tmp_path: Path) -> None:
    of_panoramas, of_pinholes = tmp_path / "panoramas", tmp_path / "pinholes"
    poses = panoramas.write(of_panoramas / "images", panoramas.walk(COUNT), WIDTH, samples=1)
    (of_pinholes / "images").mkdir(parents=True)
    frames, points, held_out, cameras, photos = [], list[str](), [], [], []
    for number, (name, pose) in enumerate(poses.items()):
        focal = WIDTH / (2 * np.pi)
        camera = Camera(WIDTH, WIDTH // 2, focal, focal, WIDTH / 2, WIDTH / 4, pose)
        lens = Lens(PANORAMA, (WIDTH, WIDTH / 2), WIDTH, WIDTH // 2)
        for face in faces.faces_of(View(name, camera, of_panoramas / name, lens=lens)):
            side, (pixels, depths) = face.camera.width, photograph(panoramas.room(), face.camera)
            file = face.name.replace(".jpg/", "_") + ".png"
            Image.fromarray(pixels).save(of_pinholes / "images" / file)
            size = {"w": side, "h": side, "fl_x": face.camera.fx, "fl_y": face.camera.fy}
            frames.append(frame(file, face.camera.viewmat, **size))
            row, column = np.mgrid[2:side:6, 2:side:6].reshape(2, -1)
            place = face.camera.unproject(column + 0.5, row + 0.5, depths[row, column])
            points += [
                " ".join(map(str, (*xyz, *rgb))) for xyz, rgb in zip(place, pixels[row, column], strict=True)
            ]
            if number in HELD_OUT:
                held_out.append(f"images/{file}")
                cameras.append(face.camera)
                photos.append(pixels)
    for capture in (of_panoramas, of_pinholes):
        fields = [*(f"property float {axis}" for axis in "xyz"), *(f"property uchar {c}" for c in COLORS)]
        header = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *fields, "end_header"]
        (capture / "points.ply").write_text("\n".join([*header, *points, ""]))
    trained_on = [each["file_path"] for each in frames if each["file_path"] not in held_out]
    pinholes = trained(of_pinholes, frames, train_filenames=trained_on, test_filenames=held_out)
    given = [frame(name, pose, camera_model=PANORAMA) for name, pose in poses.items()]
    spheres = trained(of_panoramas, given)
    assert psnr(spheres, cameras, photos) > psnr(pinholes, cameras, photos) - 1.0
    report = json.loads((spheres / "report.json").read_text())
    assert {view["name"] for view in report["views"] if view["split"] == "test"} == {
        f"pano_{number:02d}.jpg/{face}" for number in HELD_OUT for face in faces.FACES
    }
    listed = json.loads((spheres / "cameras.json").read_text())["cameras"]
    assert len(listed) == 6 * COUNT
    with zipfile.ZipFile(spheres / "cameras.zip") as archive:
        written = json.loads(archive.read("transforms.json"))
    assert [each["file_path"] for each in written["frames"]] == [f"images/{name}" for name in poses]
    assert written["test_filenames"] == [f"images/pano_{number:02d}.jpg" for number in HELD_OUT]
