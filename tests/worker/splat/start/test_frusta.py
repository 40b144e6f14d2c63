"""Proves where Gaussians start without points: in the visual hull of transparent photos, else where cameras look.

Does not prove that training finds surfaces from there.
"""

from __future__ import annotations

import numpy as np
import torch

from splatmill_worker.splat.start import frusta
from tests.support import still_life


def test_transparent_photos_start_as_their_visual_hull() -> None:
    targets = [view.full for view in still_life.training_views(alpha=True)]
    points, colors = frusta.sample_frusta(targets, 800, 0)
    assert points.shape == (800, 3)
    assert colors.dtype == torch.uint8
    outside = 0
    for target in targets:
        columns, rows, _, inside = target.camera.project(points.double().numpy())
        assert target.alpha is not None
        alpha = target.alpha.numpy()[rows[inside].astype(int), columns[inside].astype(int)]
        outside += int((alpha == 0).sum())
    assert outside < 0.05 * 800 * len(targets)


def test_opaque_photos_start_where_most_cameras_look() -> None:
    targets = [view.full for view in still_life.training_views()]
    points, colors = frusta.sample_frusta(targets, 500, 0)
    assert points.shape == colors.shape == (500, 3)
    counts = sum(target.camera.project(points.double().numpy()).inside.astype(int) for target in targets)
    assert float(np.median(counts)) > 0.7 * len(targets)
    again, _ = frusta.sample_frusta(targets, 500, 0)
    assert torch.equal(again, points)
    assert not torch.equal(frusta.sample_frusta(targets, 500, 1)[0], points)


def test_cameras_in_one_place_have_a_distance_all_the_same() -> None:
    assert frusta.median_distance(np.array([[3.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.zeros(3)) == 2.0
    assert frusta.median_distance(np.zeros((3, 3)), np.zeros(3)) == 1.0
