"""Captures with cameras and without points, in each format: fox with its points taken away, and the still life's truth.

Photos of shared captures are linked, never copied.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from _data import FOLDERS, SHARED

from splatmill_worker import synthetic
from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import View
from splatmill_worker.sfm.posed.written import transforms_of

FOX = SHARED / FOLDERS["fox"]

WITH_POINTS = {
    "fox-no-points": "fox",
    "fox-text-no-points": "fox",
    "fox-transforms": "fox",
    "fox-blender": "fox",
    "synthetic-posed": "synthetic",
}
"""The scene with points that each is compared with. fox is a COLMAP model without points3D, binary and as text, a
transforms.json without a cloud, and a Blender data set; the still life has its true cameras as transforms.json."""

SCENES = tuple(WITH_POINTS)


def available(name: str) -> bool:
    """Whether the photos of a scene are there."""
    return FOX.is_dir() or not name.startswith("fox")


def make(name: str, capture: Path, photos: int) -> None:
    """Write the capture of one of SCENES to the new folder `capture`; the still life has `photos` photos."""
    part = capture.with_name("capture.part")
    shutil.rmtree(part, ignore_errors=True)
    (part / "poses").mkdir(parents=True)
    if name == "synthetic-posed":
        (part / "images").mkdir()
        truth = synthetic.capture(part / "images", photos)
        views = [View(photo, camera, part / "images" / photo) for photo, camera in truth.items()]
        document = transforms_of(views, frozenset())
        (part / "poses" / "transforms.json").write_text(json.dumps(document))
    else:
        (part / "images").symlink_to(FOX / "images")
        _fox(name, part / "poses")
    part.rename(capture)


def _fox(name: str, poses: Path) -> None:
    """fox's cameras in the format of the scene; the held-out photos are those of fox."""
    if name == "fox-no-points":
        for stem in ("cameras", "images", "frames", "rigs"):
            shutil.copy(FOX / "sparse" / "0" / f"{stem}.bin", poses)
    elif name == "fox-text-no-points":
        pycolmap.Reconstruction(FOX / "sparse" / "0").write_text(poses)
        (poses / "points3D.txt").write_text("")
    else:
        document = json.loads((FOX / "transforms.json").read_text())
        document.pop("ply_file_path", None)
        if name == "fox-transforms":
            (poses / "transforms.json").write_text(json.dumps(document))
            return
        frames = sorted(document["frames"], key=lambda frame: frame["file_path"])
        parts = {"test": frames[::8], "train": [each for at, each in enumerate(frames) if at % 8]}
        for split, own in parts.items():
            (poses / f"transforms_{split}.json").write_text(json.dumps({**document, "frames": own}))
