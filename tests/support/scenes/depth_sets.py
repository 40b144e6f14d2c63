"""A data set with depth maps: the photos of the still life, and what a depth camera beside each would measure."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from splatmill_worker.scene import Camera, Float
from splatmill_worker.synthetic import orbit, photograph, still_life
from tests.support import posed_sets

DEPTH_SIZE = 96, 72
"""Pixels of a depth map, across and down."""

REACH = 15.0
"""Behind it, nothing comes back: the dome."""

NOISE = 0.004
"""Standard deviation of a distance, as a share of it."""

SURE = 255
"""The highest of Polycam's levels of confidence: 0, 54 and 255."""


def measured(camera: Camera, seed: int) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint8]]:
    """The depth map of a camera in millimetres, with noise, and its confidence: low at edges, where it is wrong."""
    random = np.random.default_rng(seed)
    width, height = DEPTH_SIZE
    depth = photograph(still_life(0), camera.scaled_to(width, height), samples=1)[1].astype(np.float64)
    steps = np.abs(np.diff(depth, axis=1, append=depth[:, -1:])) + np.abs(
        np.diff(depth, axis=0, append=depth[-1:])
    )
    edges = steps > 0.1
    noisy = depth * (1.0 + random.normal(0.0, NOISE, depth.shape))
    noisy[edges] *= 1.3
    confidence = np.where(edges, 0, np.where(random.random(depth.shape) < 0.05, 54, SURE)).astype(np.uint8)
    return np.where(depth < REACH, 1000.0 * noisy, 0.0).round().astype(np.uint16), confidence


def data_set(
    folder: Path,
    count: int = 14,
    size: tuple[int, int] = (192, 144),
    *,
    change: Callable[[npt.NDArray[np.uint16]], npt.NDArray[Any]] = lambda levels: levels,
    document: dict[str, Any] | None = None,
    named: bool = True,
) -> dict[str, Camera]:
    """Photos, transforms.json, depth/ and confidence/; returns the cameras.

    change: of the levels of each depth map. document: other members of transforms.json. named: whether its frames name
    the depth maps, so that they are in millimetres.
    """
    cameras = {f"{k:02d}.png": camera for k, camera in enumerate(orbit(count, *size))}
    for part in ("images", "depth", "confidence"):
        (folder / part).mkdir(parents=True)
    for k, (name, camera) in enumerate(cameras.items()):
        Image.fromarray(photograph(still_life(0), camera, samples=1)[0]).save(folder / "images" / name)
        levels, confidence = measured(camera, k)
        Image.fromarray(change(levels)).save(folder / "depth" / name)
        Image.fromarray(confidence).save(folder / "confidence" / name)
    whole = posed_sets.document(cameras) | (document or {})
    if named:
        for frame in whole["frames"]:
            frame["depth_file_path"] = f"depth/{Path(frame['file_path']).name}"
    (folder / "transforms.json").write_text(json.dumps(whole))
    return cameras


def off_surface(points: Float, cameras: dict[str, Camera]) -> Float:
    """Distance of points [n,3] from the true surface along the optical axis of the camera that sees them closest to it,
    as a share of the depth; inf where none sees a point."""
    least = np.full(len(points), np.inf)
    for camera in cameras.values():
        depth = photograph(still_life(0), camera, samples=1)[1].astype(np.float64)
        projection = camera.project(points)
        rows = np.flatnonzero(projection.inside)
        true = depth[projection.rows[rows].astype(int), projection.columns[rows].astype(int)]
        least[rows] = np.minimum(least[rows], np.abs(projection.depths[rows] / true - 1.0))
    return least
