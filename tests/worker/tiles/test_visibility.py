"""What a part of a photo makes larger than the whole photo does: the scores and the extents that densification reads.

Does not prove which parts show a tile: tests/worker/tiles/test_scene.py trains on them.
"""

from __future__ import annotations

import pytest
import torch

from splatmill_worker.kernels.records import Rates
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.start.points import from_points
from splatmill_worker.splat.views import Target
from splatmill_worker.tiles.visibility import Enlarged, Part
from tests.support import still_life

STILL = Rates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
SIDES = (24, 16, 72, 52)  # left, top, right, bottom: half of the photo's width, and half of its height


def measured(gaussians: Gaussians, target: Target) -> tuple[torch.Tensor, torch.Tensor]:
    """The score and the extent [N] of each Gaussian after one step on a photo that moves none."""
    engine = open_engine(gaussians, "cpu")
    engine.keep_scores = True
    engine.train_photo(target.viewmat, target.K, target.rgb, degree=0, rates=STILL, step=1, mask=target.mask)
    return engine.plain_sum, engine.max_extent


@pytest.mark.parametrize("masked", [False, True])
def test_scores_and_extents_of_a_part_are_those_of_the_whole_but_for_their_scales(masked: bool) -> None:
    view = still_life.training_views()[0]
    gaussians = from_points(*still_life.points())
    left, top, right, bottom = SIDES
    counted = torch.ones(bottom - top, right - left, dtype=torch.bool)
    if masked:
        counted[:, :8] = False
    part = Part(left, top, right, bottom, counted).of(view).full
    enlarged = Enlarged.of(view.full, part)
    assert enlarged.extent == 2.0
    assert enlarged.score == pytest.approx(0.5 * 4.0 * counted.numel() / int(counted.sum()))
    whole_score, whole_extent = measured(gaussians, view.full)
    score, extent = measured(gaussians, part)
    # A pixel's window of SSIM is 5 pixels wide to each side, and so are those of the pixels in it.
    seen = view.full.camera.project(gaussians.means.double().numpy())
    rows, columns = torch.from_numpy(seen.rows), torch.from_numpy(seen.columns)
    reach = 11 + whole_extent * max(view.full.rgb.shape[:2]) / 2
    inside = torch.from_numpy(seen.inside) & (whole_score > 0)
    inside &= (columns - reach > left + (8 if masked else 0)) & (columns + reach < right)
    inside &= (rows - reach > top) & (rows + reach < bottom)
    assert inside.sum() > 20
    ratio = score[inside] / enlarged.score / whole_score[inside]
    assert ratio.median().item() == pytest.approx(1.0, abs=0.03)
    assert ((ratio - 1.0).abs() < 0.05).float().mean() > 0.9
    assert torch.equal(extent[inside] / enlarged.extent, whole_extent[inside])
