"""Proves that a training makes as good a scene of panoramas with cameras, and of photos of a fisheye lens that
sees more than what is ahead, as of pinhole photos that cover the same directions, within 1 dB; and that its files name
the faces and hold out whole photos.

The pinhole photos are those that the ray caster renders at the places of the faces; both models are compared with those
at held-out places. Both start from the same points, as such small photos have few features. Not proven: how panoramas
train whose cameras are recovered; tests/worker/sfm/test_panoramas.py has their cameras.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatmill.schema import TrainOptions
from splatmill_worker import pipeline
from splatmill_worker.images.lens import PANORAMA, pinhole
from splatmill_worker.images.panoramas import faces
from splatmill_worker.scene import Camera, Lens, View
from splatmill_worker.splat.formats import registry
from splatmill_worker.splat.render import render
from splatmill_worker.synthetic.ray_caster import photograph
from tests.support import panoramas
from tests.support.posed_sets import frame_of

pytestmark = pytest.mark.slow

COUNT, WIDTH = 10, 256
FISHEYE = 200.0
"""Degrees that the fisheye lens sees across."""

COLORS = ("red", "green", "blue")
HELD_OUT = (0, 8)
"""Panoramas of ten in order that a training holds out."""


def trained(capture: Path, frames: list[dict[str, Any]], **lists: Any) -> Path:
    document = {"frames": frames, "ply_file_path": "points.ply", **lists}
    (capture / "transforms.json").write_text(json.dumps(document))
    options = TrainOptions.model_validate({"steps": 150, "backend": "cpu", "lpips": "off"})
    outcome = pipeline.run(capture, capture / "work", options, lambda _: None, lambda: False)
    assert outcome.ended == "succeeded"
    return outcome.out


@dataclass(frozen=True)
class Held:
    """A face at a held-out place.

    camera: of the face.
    pixels: as the ray caster sees it, uint8 [H,W,3].
    shown: which of them the photo shows [H,W].
    """

    camera: Camera
    pixels: np.ndarray
    shown: np.ndarray


def psnr(out: Path, held_out: list[Held]) -> float:
    """Mean PSNR of a model at these cameras in its own world."""
    gaussians = registry.read(out / "model.ply").gaussians
    errors = [
        np.square(render(gaussians, held.camera).color.clamp(0, 1).numpy() - held.pixels / 255)[
            held.shown
        ].mean()
        for held in held_out
    ]
    return float(np.mean(-10 * np.log10(errors)))


def panoramic(folder: Path) -> list[View]:
    """Views of panoramas in a folder."""
    focal = WIDTH / (2 * np.pi)
    lens = Lens(PANORAMA, (WIDTH, WIDTH / 2), WIDTH, WIDTH // 2)
    return [
        View(
            name,
            Camera(WIDTH, WIDTH // 2, focal, focal, WIDTH / 2, WIDTH / 4, pose),
            folder / name,
            lens=lens,
        )
        for name, pose in panoramas.write(folder, panoramas.walk(COUNT), WIDTH, samples=1).items()
    ]


def fisheye(folder: Path) -> list[View]:
    """Views of photos of a fisheye lens in a folder, of FISHEYE degrees in a dark frame."""
    folder.mkdir(parents=True)
    focal = WIDTH / (2 * np.pi)
    side = 2 * round(focal * np.radians(FISHEYE) / 2) + 2
    lens = Lens("OPENCV_FISHEYE", (focal, focal, side / 2, side / 2, 0.0, 0.0, 0.0, 0.0), side, side)
    views = []
    for number, pose in enumerate(panoramas.walk(COUNT)):
        path = folder / f"pano_{number:02d}.jpg"
        pixels = panoramas.fisheye(panoramas.room(), pose, (side, side), focal, FISHEYE, 1)
        Image.fromarray(pixels).save(path, quality=95, subsampling=0)
        views.append(View(path.name, pinhole(lens, pose), path, lens=lens))
    return views


def shown_by(view: View, face: View, degrees: float) -> np.ndarray:
    """Which pixels of a face lie within so many degrees from the axis of the photo."""
    row, column = np.mgrid[: face.camera.height, : face.camera.width] + 0.5
    rays = np.stack([*face.camera.normalized(column, row), np.ones(row.shape)], axis=-1)
    ahead = (
        rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ face.camera.viewmat[:3, :3] @ view.camera.axis
    )
    return np.asarray(ahead > np.cos(np.radians(degrees)))


@pytest.mark.parametrize(
    ("photographed", "degrees", "names"),
    [
        (panoramic, 181.0, tuple(faces.FACES)),
        (fisheye, FISHEYE / 2 - 1.5, ("front", "right", "left", "up", "down")),
    ],
)
def test_photos_of_all_directions_train_as_well_as_pinhole_photos_of_the_same(
    tmp_path: Path, photographed: Callable[[Path], list[View]], degrees: float, names: tuple[str, ...]
) -> None:
    of_photos, of_pinholes = tmp_path / "photos", tmp_path / "pinholes"
    views = photographed(of_photos / "images")
    for folder in ("images", "masks"):
        (of_pinholes / folder).mkdir(parents=True)
    frames, points, test_names, held_out = [], list[str](), [], list[Held]()
    for number, view in enumerate(views):
        assert tuple(face.name.split("/")[1] for face in faces.faces_of(view)) == tuple(
            name for name in faces.FACES if name in names
        )
        for face in faces.faces_of(view):
            width, height = face.camera.width, face.camera.height
            pixels, depths = photograph(panoramas.room(), face.camera, 1)
            file = face.name.replace(".jpg/", "_") + ".png"
            Image.fromarray(pixels).save(of_pinholes / "images" / file)
            shown = shown_by(view, face, degrees)
            Image.fromarray(shown.astype(np.uint8) * 255).save(of_pinholes / "masks" / file)
            size = {"w": width, "h": height, "fl_x": face.camera.fx, "fl_y": face.camera.fy}
            frames.append(frame_of(file, face.camera.viewmat, **size, cx=face.camera.cx, cy=face.camera.cy))
            row, column = np.mgrid[2:height:6, 2:width:6].reshape(2, -1)
            row, column = row[shown[row, column]], column[shown[row, column]]
            place = face.camera.unproject(column + 0.5, row + 0.5, depths[row, column])
            points += [
                " ".join(map(str, (*xyz, *rgb))) for xyz, rgb in zip(place, pixels[row, column], strict=True)
            ]
            if number in HELD_OUT:
                test_names.append(f"images/{file}")
                held_out.append(Held(face.camera, pixels, shown))
    for capture in (of_photos, of_pinholes):
        fields = [*(f"property float {axis}" for axis in "xyz"), *(f"property uchar {c}" for c in COLORS)]
        header = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *fields, "end_header"]
        (capture / "points.ply").write_text("\n".join([*header, *points, ""]))
    trained_on = [each["file_path"] for each in frames if each["file_path"] not in test_names]
    pinholes = trained(of_pinholes, frames, train_filenames=trained_on, test_filenames=test_names)
    sphere_frames = [frame_of(view.name, view.camera.viewmat, **intrinsics(view)) for view in views]
    spheres = trained(of_photos, sphere_frames)
    ours, theirs = psnr(spheres, held_out), psnr(pinholes, held_out)
    assert ours > theirs - 1.0
    report = json.loads((spheres / "report.json").read_text())
    assert {view["name"] for view in report["views"] if view["split"] == "test"} == {
        f"pano_{number:02d}.jpg/{face}" for number in HELD_OUT for face in names
    }
    listed = json.loads((spheres / "cameras.json").read_text())["cameras"]
    assert len(listed) == len(names) * COUNT
    with zipfile.ZipFile(spheres / "cameras.zip") as archive:
        written = json.loads(archive.read("transforms.json"))
    assert [each["file_path"] for each in written["frames"]] == [f"images/{view.name}" for view in views]
    assert written["test_filenames"] == [f"images/pano_{number:02d}.jpg" for number in HELD_OUT]


def intrinsics(view: View) -> dict[str, Any]:
    """The fields of transforms.json for the lens of a view."""
    assert view.lens is not None
    if view.lens.model == PANORAMA:
        return {"camera_model": PANORAMA}
    fx, fy, cx, cy, *_ = view.lens.params
    size = {"w": view.lens.width, "h": view.lens.height}
    return {"camera_model": view.lens.model, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, **size}
