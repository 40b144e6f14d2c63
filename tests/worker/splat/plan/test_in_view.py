"""Steps leave out clusters where photos have little of a large scene in view, with the cpu kernels alone, and the share
that they have in view is measured. Does not prove that the thresholds are the best ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from splatmill_worker.kernels import ops
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.plan.facts import measure
from splatmill_worker.splat.start.points import from_points
from tests.support import still_life
from tests.support.plans.facts import changed, planned
from tests.support.training import sparse_scene

LARGE: dict[str, Any] = {"views": 400, "width": 640, "height": 480, "memory_available": 64 * 10**9}


def test_a_large_scene_of_which_photos_have_little_in_view() -> None:
    plan = planned(changed(sky_share=0.0, in_view=0.07, **LARGE))
    assert plan.cluster_culling
    assert "7 % of the points" in plan.reasons["cluster_culling"]
    assert not planned(changed(sky_share=0.0, in_view=0.07, **LARGE), cluster_culling="off").cluster_culling


@pytest.mark.parametrize(
    ("change", "options", "because"),
    [
        ({"in_view": 0.6}, {}, "60 % of the points"),
        ({"in_view": 0.07}, {"max_gaussians": 50_000}, "50000 Gaussians are too few"),
        ({"in_view": 0.07}, {"kernels": "gpu"}, "The gpu kernels"),
        ({"in_view": 0.07}, {"kernels": "reference"}, "The reference"),
    ],
)
def test_it_is_left_where_it_does_not_pay(
    change: dict[str, Any], options: dict[str, Any], because: str
) -> None:
    plan = planned(changed(sky_share=0.0, **change, **LARGE), **options)
    assert not plan.cluster_culling
    assert because in plan.left_out["cluster_culling"]


def test_what_photos_have_in_view_may_not_be_known() -> None:
    assert "11450 points" in planned(changed(**LARGE)).left_out["cluster_culling"]
    assert "3 photos are transparent" in planned(changed(transparent=3, **LARGE)).left_out["cluster_culling"]


@pytest.mark.parametrize("kernels", ["gpu", "reference"])
def test_other_kernels_cannot_be_asked_for_it(kernels: ops.Backend) -> None:
    with pytest.raises(ValueError, match="cluster_culling=on is for the cpu kernels"):
        planned(changed(**LARGE), kernels=kernels, cluster_culling="on")
    with pytest.raises(ValueError, match="computes all Gaussians"):
        open_engine(from_points(*still_life.points()), kernels, clustered=True)


def test_the_share_in_view_is_that_of_the_points_within_the_frame() -> None:
    world, views = sparse_scene()
    coverage = measure(world, views, 0, None)[0].coverage
    assert coverage is not None
    shares = [view.full.camera.project(world.points).inside.mean() for view in views]
    assert coverage.in_view == pytest.approx(float(np.median(shares)), abs=0.05)
    assert 0.0 < coverage.in_view <= 1.0
