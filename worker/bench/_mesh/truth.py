"""How far a mesh is from the true surface of the still life: distances both ways, within the cylinder over its table.

From a mesh to the truth, distances are exact; from the truth to a mesh they are those to its nearest sample. The truth
counts where two cameras see it: nothing can be known of the undersides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree

from splatmill_worker.mesh.triangles import Mesh
from splatmill_worker.scene import Camera
from splatmill_worker.synthetic.ray_caster import Box, Cylinder, Disc, Solid, Sphere, StillLife

Float = npt.NDArray[np.float64]

SIZE = 3.8
"""The size of the scene: the diameter of its table, world units."""

SHARES = (0.0025, 0.005, 0.01)
"""The thresholds, of the size."""

TOP, BOTTOM = 1.3, -0.05
"""World units: the region's height. The highest thing ends at 1.2, and the floor lies at -0.9."""

SAMPLES = 200_000
"""Points on each of the two surfaces. On the truth, which has 16 square units, they are 0.009 apart."""

MIN_CAMERAS = 2
"""Cameras that must see a point of the truth."""


def scores(mesh: Mesh, truth: Float, life: StillLife) -> dict[str, float]:
    """Chamfer distance (mean of both means, world units), and precision, recall and F-score at SHARES of the size."""
    samples = on_mesh(mesh)
    samples = samples[within(samples)]
    figures: dict[str, float] = {}
    if not len(samples):
        names = ("precision", "completeness", "f")
        return {"chamfer": math.inf} | {f"{name}_{share:g}": 0.0 for name in names for share in SHARES}
    to_truth = distances(samples, life.solids)
    to_mesh = cKDTree(samples).query(truth)[0]
    figures["chamfer"] = float(to_truth.mean() + to_mesh.mean()) / 2
    for share in SHARES:
        precision = float((to_truth < share * SIZE).mean())
        recall = float((to_mesh < share * SIZE).mean())
        figures[f"precision_{share:g}"], figures[f"completeness_{share:g}"] = precision, recall
        figures[f"f_{share:g}"] = 2 * precision * recall / max(precision + recall, 1e-12)
    return figures


def within(points: Float) -> npt.NDArray[np.bool_]:
    """Which points [n, 3] lie over the table."""
    radius = np.hypot(points[:, 0], points[:, 1])
    inside: npt.NDArray[np.bool_] = (radius < SIZE / 2) & (points[:, 2] > BOTTOM) & (points[:, 2] < TOP)
    return inside


def on_mesh(mesh: Mesh) -> Float:
    """SAMPLES points [n, 3] on the part of a mesh over the table, evenly by area."""
    mesh = mesh.only(within(mesh.vertices[mesh.faces].astype(np.float64).mean(axis=1)))
    areas = mesh.areas()
    if not areas.sum() > 0:
        return np.zeros((0, 3))
    random = np.random.default_rng(0)
    rows = random.choice(len(areas), SAMPLES, p=areas / areas.sum())
    a, b, c = (mesh.vertices[mesh.faces[rows, corner]].astype(np.float64) for corner in range(3))
    u, v = np.sqrt(random.random((SAMPLES, 1))), random.random((SAMPLES, 1))
    points: Float = (1 - u) * a + u * (1 - v) * b + u * v * c
    return points


def visible(life: StillLife, cameras: Sequence[Camera]) -> Float:
    """Points [n, 3] of the true surface over the table that MIN_CAMERAS cameras see, evenly by area."""
    random = np.random.default_rng(1)
    solids = [solid for solid in life.solids if not isinstance(solid, Disc) or solid.z == 0.0]
    areas = np.array([area(solid) for solid in solids])
    counts = (SAMPLES * areas / areas.sum()).astype(int)
    points = np.concatenate([on_solid(s, n, random) for s, n in zip(solids, counts, strict=True)])
    points = points[within(points)]
    sightings = np.zeros(len(points), int)
    for camera in cameras:
        sightings += camera.project(points).inside & unhidden(life, camera, points)
    return points[sightings >= MIN_CAMERAS]


def unhidden(life: StillLife, camera: Camera, points: Float) -> npt.NDArray[np.bool_]:
    """Which points [n, 3] are the first that a ray from the camera meets."""
    eye = torch.from_numpy(camera.center.astype(np.float32))
    rays = torch.from_numpy(points.astype(np.float32)) - eye
    length = rays.norm(dim=1)
    rays = rays / length[:, None]
    free = torch.ones(len(points), dtype=torch.bool)
    for solid in life.solids:
        free &= ~(solid.hit(eye, rays) < length - 2e-3)
    return free.numpy()


def area(solid: Solid) -> float:
    """Of a solid's surface, without the lower end of a cylinder, square world units."""
    match solid:
        case Disc():
            return math.pi * (SIZE / 2) ** 2
        case Box():
            x, y, z = solid.half
            return 8 * (x * y + y * z + z * x)
        case Sphere():
            return 4 * math.pi * solid.radius**2
        case Cylinder():
            return 4 * math.pi * solid.radius * solid.half_height + math.pi * solid.radius**2


def on_solid(solid: Solid, count: int, random: np.random.Generator) -> Float:
    """`count` points [n, 3] on the surface of a solid, evenly by area."""
    if isinstance(solid, Disc):
        radius, angle = solid.radius * np.sqrt(random.random(count)), 2 * np.pi * random.random(count)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, solid.z)], axis=1)
    center = np.array(solid.center)
    if isinstance(solid, Sphere):
        direction = random.normal(size=(count, 3))
        unit: Float = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        return center + solid.radius * unit
    if isinstance(solid, Cylinder):
        side = 4 * math.pi * solid.radius * solid.half_height
        on_side = random.random(count) < side / area(solid)
        angle = 2 * np.pi * random.random(count)
        radius = np.where(on_side, 1.0, np.sqrt(random.random(count))) * solid.radius
        z = np.where(on_side, random.uniform(-1, 1, count), 1.0) * solid.half_height
        return center + np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    half = np.array(solid.half)
    faces = np.array([half[1] * half[2], half[2] * half[0], half[0] * half[1]])
    axis = random.choice(3, count, p=faces / faces.sum())
    local = random.uniform(-1, 1, (count, 3))
    local[np.arange(count), axis] = random.choice((-1.0, 1.0), count)
    local *= half
    c, s = math.cos(solid.turn), math.sin(solid.turn)
    return center + np.stack(
        [c * local[:, 0] - s * local[:, 1], s * local[:, 0] + c * local[:, 1], local[:, 2]], axis=1
    )


def distances(points: Float, solids: Sequence[Solid]) -> Float:
    """Distance [n] from points [n, 3] to the nearest surface of the solids."""
    nearest: Float = np.min([distance(points, solid) for solid in solids], axis=0)
    return nearest


def distance(points: Float, solid: Solid) -> Float:
    """Distance [n] from points [n, 3] to the surface of one solid."""
    if isinstance(solid, Disc):
        beyond = np.maximum(np.hypot(points[:, 0], points[:, 1]) - solid.radius, 0.0)
        return np.asarray(np.hypot(beyond, points[:, 2] - solid.z), np.float64)
    local = points - np.array(solid.center)
    if isinstance(solid, Sphere):
        return np.asarray(np.abs(np.linalg.norm(local, axis=1) - solid.radius), np.float64)
    if isinstance(solid, Cylinder):
        q = np.stack(
            [np.hypot(local[:, 0], local[:, 1]) - solid.radius, np.abs(local[:, 2]) - solid.half_height], 1
        )
    else:
        c, s = math.cos(solid.turn), math.sin(solid.turn)
        turned = np.stack(
            [c * local[:, 0] + s * local[:, 1], c * local[:, 1] - s * local[:, 0], local[:, 2]], 1
        )
        q = np.abs(turned) - np.array(solid.half)
    outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
    return np.asarray(np.abs(outside + np.minimum(q.max(axis=1), 0.0)), np.float64)
