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


class Missing(Exception):
    """A library of the comparison is not installed."""


def of_sparse_points(cameras_zip: Path) -> Mesh:
    """Poisson reconstruction of a model's sparse points; a normal is that of the plane through a point's neighbours."""
    with tempfile.TemporaryDirectory(prefix="splatmill-bench-") as folder:
        with ZipFile(cameras_zip) as archive:
            archive.extractall(folder)
        model = pycolmap.Reconstruction(Path(folder) / "sparse" / "0")
    found = list(model.points3D.values())
    points = np.array([point.xyz for point in found])
    seen_from = np.array(
        [
            np.mean([model.images[e.image_id].projection_center() for e in point.track.elements], axis=0)
            for point in found
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
    volume = open3d.pipelines.integration.ScalableTSDFVolume(
        voxel_length=voxel,
        sdf_trunc=4 * voxel,
        color_type=open3d.pipelines.integration.TSDFVolumeColorType.RGB8,
    )
    for view in views:
        camera: Any = open3d.camera.PinholeCameraIntrinsic(
            view.camera.width, view.camera.height, view.camera.fx, view.camera.fy,
            view.camera.cx - 0.5, view.camera.cy - 0.5,
        )  # fmt: skip
        pair = open3d.geometry.RGBDImage.create_from_color_and_depth(
            open3d.geometry.Image(np.ascontiguousarray(view.color.numpy())),
            open3d.geometry.Image(view.depth.numpy()),
            depth_scale=1.0, depth_trunc=most, convert_rgb_to_intensity=False,
        )  # fmt: skip
        volume.integrate(pair, camera, view.camera.viewmat)
    found = volume.extract_triangle_mesh()
    return Mesh(
        np.asarray(found.vertices, np.float32),
        np.asarray(found.triangles, np.int32),
        (255 * np.asarray(found.vertex_colors)).astype(np.uint8),
    )
