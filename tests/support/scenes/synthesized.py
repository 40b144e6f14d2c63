"""COLMAP's own generated scene: matches in a database, and the true poses."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from splatmill_worker.colmap import pycolmap


def synthesized(path: Path, photos: int) -> pycolmap.Reconstruction:
    """Write the matches of so many photos of 300 points to a database at `path`; returns their true poses."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = options.num_cameras_per_rig = 1
    options.num_frames_per_rig, options.num_points3D = photos, 300
    pycolmap.set_random_seed(0)
    with closing(pycolmap.Database.open(path)) as database:
        return pycolmap.synthesize_dataset(options, database)
