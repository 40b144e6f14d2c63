"""Every backend draws every pixel of every case as the definition does, within what rounding explains there (`units`).

The definition is the float64 reference; that it is right is shown by test_reference_*. Nothing here is about
gradients.
"""

from __future__ import annotations

import pytest
import torch

from tests.support.kernels.bounds import within
from tests.support.kernels.cases import CASES
from tests.support.kernels.exact import exact
from tests.support.kernels.proof import alpha_error, backends, brightest, peak, run, use


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize("name", CASES)
def test_image_is_the_definitions(name: str, backend: str) -> None:
    known = exact(name)
    case, want, near = known.case, known.want, known.undecided
    with use(backend) as op:
        got = run(case, op)
    unit = known.units.separate
    color, depth = brightest(want)
    for label, a, b, largest in (
        ("color", got.color, want.color, color),
        ("alpha", got.alpha, want.alpha, 1.0),
        ("depth", got.depth, want.depth, depth),
    ):
        off = (a.detach().cpu().double() - b.detach()).abs()
        within(label, name, off[~near], unit[label][~near])
        # A crossing may drop or add one splat at the cut (weight 1/255), or all that is left at the end (weight
        # 1e-4).
        assert float(off.max()) <= (known.rho + 2 / 255) * largest, f"{label}: more than a crossing explains"
    # Crossings are rare, or they would hide an error; the piles put one threshold on many pixels at once.
    if not name.startswith("pile") and near.numel() > 500:
        assert near.double().mean() < 0.15


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize("name", CASES)
def test_culled_rows_are_exactly_zero_and_the_same(name: str, backend: str) -> None:
    case, want = CASES[name](), exact(name).want.projected
    with use(backend) as op:
        got = run(case, op).projected
    visible, should = (got.extents.cpu() > 0).all(1), (want.extents > 0).all(1)
    for field in got:
        assert (field.detach().cpu()[~visible] == 0).all()
    # No case puts a Gaussian within rounding of a cull.
    assert torch.equal(visible, should)


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize("name", CASES)
def test_no_pair_that_reaches_a_pixel_is_missing(name: str, backend: str) -> None:
    case, want = CASES[name](), exact(name).want
    with use(backend) as op:
        got = run(case, op)
    tiles = len(want.bins.offsets) - 1
    assert len(got.bins.offsets) - 1 == tiles
    error = alpha_error(case, want.projected)
    for tile in range(tiles):
        mine = got.bins.ids[got.bins.offsets[tile] : got.bins.offsets[tile + 1]].cpu().long()
        theirs = want.bins.ids[want.bins.offsets[tile] : want.bins.offsets[tile + 1]].long()
        missing = set(theirs.tolist()) - set(mine.tolist())
        extra = set(mine.tolist()) - set(theirs.tolist())
        # A pair may differ only where the ellipse touches the tile within the error of alpha; such a pair is dim.
        for i in missing | extra:
            assert peak(want.projected, i, tile, case.width) <= (1 / 255) * (1 + 2 * float(error[i]) + 2e-4)
        depth = got.projected.depths.detach().cpu()[mine]
        order = torch.stack([depth.double(), mine.double()], 1)
        later = (order[1:, 0] > order[:-1, 0]) | (
            (order[1:, 0] == order[:-1, 0]) & (order[1:, 1] > order[:-1, 1])
        )
        assert later.all(), "front to back, ties by index"
