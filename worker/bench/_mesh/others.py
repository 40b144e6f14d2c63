"""Meshes by other means: COLMAP's Poisson reconstruction of its sparse points, and Open3D's fusion of depths."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree

from splatmill_worker.colmap import pycolmap
from splatmill_worker.mesh.depths import View
from splatmill_worker.mesh.poisson import reconstruct
from splatmill_worker.mesh.samples import Samples
from splatmill_worker.mesh.triangles import Mesh

Float = npt.NDArray[np.float64]

POISSON_DEPTH = 10
"""Levels of the octree: cells of a thousandth of the points' extent."""

NEIGHBOURS = 12
"""Points through which the plane of a sparse point is laid."""

MOST_BLOCKS, TRUNCATION, LEAST_VIEWS = 50_000, 4.0, 2.0
"""Of Open3D's field: blocks of 16 voxels a side, voxels around a surface that know their distance, and views that must
have seen a voxel."""


class Missing(Exception):
    """A library of the comparison is not installed."""


def of_sparse_points(cameras_zip: Path) -> Mesh:
    """Poisson reconstruction of a model's sparse points; a normal is that of the plane through a point's neighbours."""
    with tempfile.TemporaryDirectory(prefix="splatmill-bench-") as folder:
        with ZipFile(cameras_zip) as archive:
            archive.extractall(folder)
        model = pycolmap.Reconstruction(Path(folder) / "sparse" / "0")
    sparse = list(model.points3D.values())
    points = np.array([point.xyz for point in sparse])
    seen_from = np.array(
        [
            np.mean([model.images[e.image_id].projection_center() for e in point.track.elements], axis=0)
            for point in sparse
        ]
    )
    _, rows = cKDTree(points).query(points, NEIGHBOURS)
    near = points[rows] - points[rows].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
    towards = np.einsum("ni,ni->n", normals, seen_from - points)
    normals *= np.where(towards < 0, -1.0, 1.0)[:, None]
    samples = Samples(torch.from_numpy(points).float(), torch.from_numpy(normals).float())
    return reconstruct(samples, POISSON_DEPTH)


def by_open3d(views: Sequence[View], voxel: float, most: float) -> Mesh:
    """Open3D's truncated signed distance field of the same depths. Raises Missing where it is not installed."""
    try:
        import open3d  # a benchmark's comparison, no dependency
    except ImportError as error:
        raise Missing("open3d is not installed") from error
    tensor, image, kind = open3d.core.Tensor, open3d.t.geometry.Image, open3d.core.float32
    grid: Any = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), (kind, kind, kind), ((1), (1), (3)), voxel, 16, MOST_BLOCKS
    )
    for view in views:
        camera = view.camera
        intrinsics = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
        inner, outer = tensor(intrinsics), tensor(np.ascontiguousarray(camera.viewmat))
        depth = image(tensor(np.ascontiguousarray(view.depth.numpy())))
        color = image(tensor(view.color.numpy().astype(np.float32) / 255))
        blocks = grid.compute_unique_block_coordinates(depth, inner, outer, 1.0, most, TRUNCATION)
        grid.integrate(blocks, depth, color, inner, outer, 1.0, most, TRUNCATION)
    surface = grid.extract_triangle_mesh(weight_threshold=LEAST_VIEWS).to_legacy()
    return Mesh(
        np.asarray(surface.vertices, np.float32),
        np.asarray(surface.triangles, np.int32),
        (255 * np.asarray(surface.vertex_colors)).astype(np.uint8),
    )
