"""The still life with a simulated scan: cameras are recovered from its photos, and the scan lies elsewhere."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from splatmill_worker import synthetic
from splatmill_worker.scene import Similarity

FILE = "scan.ply"
"""Name of the scan among the poses of a capture."""

WITHOUT_SCAN = {"synthetic-scanned": "synthetic"}
"""The scene with the same photos that each is compared with."""

SCENES = tuple(WITHOUT_SCAN)

RAYS = (480, 360)
"""Rays of a station, across and down."""

TO_SCANNER = Similarity(
    np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]),
    37.0,
    np.array([500_000.0, 5_400_000.0, 300.0]),
)
"""From the still life to the scanner's world."""


def make(capture: Path, photos: int) -> None:
    """Write the capture to the new folder `capture`: `photos` photos, and a scan of three stations."""
    part = capture.with_name("capture.part")
    shutil.rmtree(part, ignore_errors=True)
    (part / "poses").mkdir(parents=True)
    synthetic.capture(part / "images", photos)
    points, colors = synthetic.scan(*RAYS)
    moved = TO_SCANNER.points(points)
    types = [*((axis, "f8") for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    rows = np.empty(len(moved), types)
    for index, (name, _) in enumerate(types):
        rows[name] = moved[:, index] if index < 3 else colors[:, index - 3]
    PlyData([PlyElement.describe(rows, "vertex")]).write(part / "poses" / FILE)
    os.replace(part, capture)
