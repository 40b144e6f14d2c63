"""Proves what a picture or video of a model without cameras shows: its dense middle, upright in every format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch

from splatmill.schema import OrbitRequest
from splatmill.schema.files.formats import MODEL_FORMATS
from splatmill_worker.render_service.encoding import camera_of, render_frame
from splatmill_worker.render_service.local import loaded, overview
from splatmill_worker.splat import orbit
from splatmill_worker.splat.formats import registry
from splatmill_worker.splat.gaussians import SH_C0, Gaussians

CENTRE = np.array([30.0, 10.0, -20.0])
SIZE = OrbitRequest.model_validate({"seconds": 0.5, "fps": 8, "width": 64, "height": 48})


Points = npt.NDArray[np.float64]


def ball(count: int) -> Points:
    """Points in a ball of radius 1 around CENTRE."""
    points = np.random.default_rng(0).uniform(-1, 1, (8 * count, 3))
    inside: Points = CENTRE + points[np.linalg.norm(points, axis=1) <= 1][:count]
    return inside


def around(count: int, distance: float, middle: Points) -> Points:
    directions = np.random.default_rng(1).normal(size=(count, 3))
    points: Points = middle + distance * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return points


@pytest.mark.parametrize(
    ("others", "opacity"),
    [
        (np.zeros((0, 3)), 1.0),
        (around(300, 50.0, CENTRE), 1.0),  # a far shell
        (around(5000, 6.0, CENTRE + np.array([6.0, 0.0, 0.0])), 0.01),  # faint floaters on one side
        (np.tile([[1e6, 0.0, 0.0]], (100, 1)), 1.0),
    ],
    ids=["nothing", "shell", "floaters", "stray"],
)
def test_the_dense_middle_fills_the_picture(others: Points, opacity: float) -> None:
    points = np.concatenate([ball(1000), others])
    opacities = np.concatenate([np.full(1000, 0.9), np.full(len(others), opacity)])
    path = orbit.path_around(points, opacities)
    assert path.target == pytest.approx(CENTRE, abs=0.3)
    assert 2.0 < path.radius < 4.0
    for camera in orbit.cameras_along(path, SIZE, orbit.DEFAULT_FOV):
        assert camera.viewmat[1, :3] @ [0.0, 1.0, 0.0] > 0.9, "y points down in the picture"
        projection = camera.project(points[:1000])
        rows, columns = np.asarray(projection.rows), np.asarray(projection.columns)
        inside = (rows > 0) & (rows < 48) & (columns > 0) & (columns < 64)
        assert inside.mean() > 0.97
        assert np.ptp(rows) > 24


def test_one_point_is_framed() -> None:
    path = orbit.path_around(np.array([CENTRE]), np.array([0.5]))
    assert (path.target.tolist(), path.radius) == (CENTRE.tolist(), 2.5)


@pytest.mark.parametrize(
    "suffix", [suffix for suffix, form in MODEL_FORMATS.items() if form.writable and form.readable]
)
def test_the_top_is_at_the_top_in_every_format(tmp_path: Path, suffix: str) -> None:
    """y points down in the frame of the `.ply`, so the red half lies above the blue one."""
    count = 600
    means = torch.from_numpy(ball(count) - CENTRE).float()
    red = means[:, 1] < 0
    colors = torch.where(red[:, None], torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]))
    scene = Gaussians(
        means,
        torch.full((count, 3), -2.0),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        torch.full((count,), 5.0),
        ((colors - 0.5) / SH_C0)[:, None],
    )
    path = tmp_path / (f"m{suffix}" if suffix.startswith(".") else suffix)
    registry.write(path, scene)
    with loaded(path) as model:
        camera = camera_of(overview(model, 64, orbit.UP))
        picture = render_frame(model, camera, "black").astype(int)
    upper, lower = picture[12:20].mean((0, 1)), picture[30:38].mean((0, 1))
    assert upper[0] > upper[2] + 50
    assert lower[2] > lower[0] + 50
