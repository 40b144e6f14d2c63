"""Panoramas of the still life in a room, made of cube faces that the ray caster renders, with exact cameras."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from splatmill_worker.scene import Camera, viewmat_of
from splatmill_worker.synthetic import still_life
from splatmill_worker.synthetic.ray_caster import Box, StillLife, picture
from splatmill_worker.synthetic.textures import MipMap, painted

CUBE = {
    (0, 1): ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    (0, -1): ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    (1, 1): ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    (1, -1): ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    (2, 1): ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    (2, -1): ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
}
"""The axes x, y and z of the camera of each face, in the panorama's frame, by its direction: an axis and a sign."""


@lru_cache(maxsize=1)
def room() -> StillLife:
    """The still life between four walls, each with a texture of its own: its sky is the same on both sides."""
    rng = np.random.default_rng(5)
    walls = [
        Box(
            (x * 5.0, y * 5.0, 1.0),
            (0.1 if x else 5.0, 5.0 if x else 0.1, 2.0),
            0.0,
            MipMap(painted(rng, 1024, density=700)),
            0.095,
        )
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    scene = still_life()
    return replace(scene, solids=(*scene.solids, *walls))


def striped(path: Path, xmp: bytes = b"", seed: int = 0) -> None:
    """Write a panorama of a sphere with stripes, 512 x 256 pixels."""
    longitude, latitude = np.meshgrid(
        (np.arange(512) + 0.5) / 512 * 2 * np.pi, (0.5 - (np.arange(256) + 0.5) / 256) * np.pi
    )
    x, y, z = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)
    grey = 128 + 50 * np.sin(9 * x + seed) + 50 * np.sin(7 * y + 5 * z)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(grey.astype(np.uint8)).convert("RGB").save(path, quality=95, xmp=xmp)


def gpano(**fields: object) -> bytes:
    """XMP with fields of GPano, as attributes."""
    values = " ".join(f'GPano:{name}="{value}"' for name, value in fields.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description '
        f'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {values}/></rdf:RDF></x:xmpmeta>'
    ).encode()


def walk(count: int, seed: int = 0) -> list[np.ndarray]:
    """World-to-camera matrices [4,4] of panoramas on a path round the table, level to a few degrees."""
    rng = np.random.default_rng(seed)
    poses = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        eye = np.array([2.6 * np.cos(angle), 2.6 * np.sin(angle), 0.6 + 0.5 * np.sin(3 * angle)])
        turn = rng.uniform(0, 2 * np.pi)
        ahead = np.array([np.cos(turn), np.sin(turn), 0.05 * rng.normal()])
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.05 * rng.normal(), 0.05 * rng.normal(), 1.0])
        right /= np.linalg.norm(right)
        poses.append(viewmat_of(np.stack([right, np.cross(ahead, right), ahead]), eye))
    return poses


def panorama(scene: StillLife, viewmat: np.ndarray, width: int, samples: int = 2) -> np.ndarray:
    """The panorama uint8 [width / 2, width, 3] of a camera with z in its middle."""
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = ((np.arange(width // 2) + 0.5) / (width // 2) - 0.5) * np.pi
    rays = np.stack(
        np.broadcast_arrays(
            np.cos(latitude)[:, None] * np.sin(longitude),
            np.sin(latitude)[:, None],
            np.cos(latitude)[:, None] * np.cos(longitude),
        ),
        axis=-1,
    )
    return seen_along(scene, viewmat, rays, width // 2, samples)


def fisheye(
    scene: StillLife,
    viewmat: np.ndarray,
    size: tuple[int, int],
    focal: float,
    degrees: float,
    samples: int = 2,
) -> np.ndarray:
    """The photo uint8 [H,W,3] of an equidistant lens in the middle of the photo, black beyond its angle of view.

    size: width and height. focal: pixels per radian.
    """
    width, height = size
    x, y = np.meshgrid(
        (np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal
    )
    angle = np.hypot(x, y)
    across = np.sinc(angle / np.pi)
    rays = np.stack([x * across, y * across, np.cos(angle)], axis=-1)
    photo = np.zeros((height, width, 3), np.uint8)
    visible = angle <= np.radians(degrees) / 2
    photo[visible] = seen_along(scene, viewmat, rays[visible], round(focal * np.pi / 2 * 1.3), samples)
    return photo


def seen_along(
    scene: StillLife, viewmat: np.ndarray, rays: np.ndarray, side: int, samples: int
) -> np.ndarray:
    """What a camera sees along rays [...,3] of its frame, uint8 [...,3], looked up in the faces of a cube.

    Of a face, only the rectangle is rendered that the rays fall into. side: pixels of a face.
    """
    largest = np.abs(rays).argmax(axis=-1)
    result = np.zeros(rays.shape, np.uint8)
    for (axis, sign), axes in CUBE.items():
        rows = (largest == axis) & (rays[..., axis] * sign > 0)
        if not rows.any():
            continue
        rotation = np.array(axes, np.float64)
        # A little more than 90 degrees, so that every ray has four pixels around it.
        focal = side / 2 / 1.02
        local = rays[rows] @ rotation.T
        x = local[:, 0] / local[:, 2] * focal + side / 2 - 0.5
        y = local[:, 1] / local[:, 2] * focal + side / 2 - 0.5
        left, top = np.floor(x).astype(int), np.floor(y).astype(int)
        first, upmost = int(left.min()), int(top.min())
        camera = Camera(
            int(left.max()) + 2 - first,
            int(top.max()) + 2 - upmost,
            focal,
            focal,
            side / 2 - first,
            side / 2 - upmost,
            viewmat_of(rotation @ viewmat[:3, :3], -viewmat[:3, :3].T @ viewmat[:3, 3]),
        )
        pixels = picture(scene, camera, samples).astype(np.float64)
        u, v = (x - left)[:, None], (y - top)[:, None]
        left, top = left - first, top - upmost
        upper = pixels[top, left] * (1 - u) + pixels[top, left + 1] * u
        lower = pixels[top + 1, left] * (1 - u) + pixels[top + 1, left + 1] * u
        result[rows] = np.round(upper * (1 - v) + lower * v).astype(np.uint8)
    return result


def write(
    folder: Path, poses: list[np.ndarray], width: int, *, xmp: bool = True, samples: int = 2
) -> dict[str, np.ndarray]:
    """Write a panorama of the room for each pose as a JPEG; returns the poses by the files' names."""
    folder.mkdir(parents=True, exist_ok=True)
    named = {f"pano_{number:02d}.jpg": pose for number, pose in enumerate(poses)}
    for name, pose in named.items():
        image = Image.fromarray(panorama(room(), pose, width, samples))
        options: dict[str, Any] = {"xmp": gpano(ProjectionType="equirectangular")} if xmp else {}
        image.save(folder / name, quality=95, subsampling=0, **options)
    return named
