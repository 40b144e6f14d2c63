"""Proves which depth map and which map of confidence belongs to which photo, by their names alone."""

from pathlib import Path

import numpy as np
import pytest

from splatmill_worker.scene import Camera, View
from splatmill_worker.sfm.depth import pairs

CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))


def view(path: Path) -> View:
    return View(path.name, CAMERA, path)


def paired(root: Path, photos: str, maps: str) -> dict[str, tuple[str | None, str | None]]:
    """The maps of each photo that has one. Names are relative to `root`."""
    for name in maps.split():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"x")
    views = [view(root / name) for name in photos.split()]
    depth_maps = pairs.maps_of([root], views)

    def called(path: Path | None) -> str | None:
        return None if path is None else path.relative_to(root).as_posix()

    return {
        views[index].image.relative_to(root).as_posix(): (called(depth), called(sure))
        for index, (depth, sure) in depth_maps.of_view.items()
    }


@pytest.mark.parametrize(
    ("photos", "maps", "expected"),
    [
        ("images/a.jpg", "poses/depth/a.png", {"images/a.jpg": ("poses/depth/a.png", None)}),
        ("A.JPG", "Depth/a.PNG", {"A.JPG": ("Depth/a.PNG", None)}),
        (
            "images/keyframes/images/1.jpg",
            "poses/keyframes/depth/1.png poses/keyframes/confidence/1.png",
            {
                "images/keyframes/images/1.jpg": (
                    "poses/keyframes/depth/1.png",
                    "poses/keyframes/confidence/1.png",
                )
            },
        ),
        (
            "video/rgb_000012.jpg",
            "depth/000012.png depth/12.png",
            {"video/rgb_000012.jpg": ("depth/000012.png", None)},
        ),
        (
            "left/rgb/1.jpg right/rgb/1.jpg",
            "left/depth/1.png right/depth/1.png",
            {"left/rgb/1.jpg": ("left/depth/1.png", None), "right/rgb/1.jpg": ("right/depth/1.png", None)},
        ),
        (
            "images/left/1.jpg images/right/1.jpg",
            "poses/depth/left/1.png poses/depth/right/1.png",
            {
                "images/left/1.jpg": ("poses/depth/left/1.png", None),
                "images/right/1.jpg": ("poses/depth/right/1.png", None),
            },
        ),
        ("images/1.jpg", "a/depth/1.png b/depth/1.png", {}),
        ("images/a.jpg", "depth/b.png normals/a.png confidence/a.png", {}),
    ],
)
def test_maps_belong_to_photos_by_name(
    tmp_path: Path, photos: str, maps: str, expected: dict[str, tuple[str | None, str | None]]
) -> None:
    assert paired(tmp_path, photos, maps) == expected


def test_maps_that_belong_to_none_are_named(tmp_path: Path) -> None:
    paired(tmp_path, "", "depth/a.png depth/b.png confidence/a.png")
    maps = pairs.maps_of([tmp_path], [view(tmp_path / "a.jpg")])
    assert maps.unpaired == ("depth/b.png",)
    assert maps.names == {"depth/a.png", "depth/b.png", "confidence/a.png"}
