"""Median depth: by hand, and every build against the definition on the shared cases.

At each pixel a backend has to show the splat of the definition, or one that the errors of the alphas allow to be the
first at which the transmittance is one half or less. Says nothing about gradients: the op has none.
"""

from __future__ import annotations

import pytest
import torch

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import Bins, Projected
from tests.support.kernels.cases import CASES
from tests.support.kernels.median import agrees, fields_of
from tests.support.kernels.proof import backends, use

BUILDS = [b for b in backends() if str(b).startswith("cpu")]


def discs(opacities: list[float], depths: list[float]) -> Projected:
    """Splats as wide as the image, one behind the other, centred at (8, 8)."""
    n = len(depths)
    return Projected(
        torch.full((n, 2), 8.0),
        torch.tensor([[1e-9, 0.0, 1e-9]]).repeat(n, 1),
        torch.tensor(opacities),
        torch.zeros(n, 3),
        torch.tensor(depths),
        torch.full((n, 2), 1e4),
    )


def listed(n: int) -> Bins:
    return Bins(torch.tensor([0, n]), torch.arange(n, dtype=torch.int32))


@pytest.mark.parametrize("backend", ["reference", *BUILDS])
@pytest.mark.parametrize(
    ("opacities", "depths", "expected"),
    [
        ([0.4, 0.4, 0.9], [1.0, 2.0, 3.0], 2.0),  # 0.6, then 0.36
        ([0.6, 0.9], [1.0, 2.0], 1.0),
        ([0.3, 0.25], [1.0, 2.0], 0.0),  # 0.525 is left
        ([0.501], [4.0], 4.0),
        ([0.003, 1.0], [1.0, 5.0], 5.0),  # below 1/255 the first counts for nothing
        ([], [], 0.0),
    ],
)
def test_the_splat_that_leaves_half_gives_the_depth(
    backend: str, opacities: list[float], depths: list[float], expected: float
) -> None:
    with use(backend) as op:
        depth = ops.median_depth(discs(opacities, depths), listed(len(depths)), 16, 16, backend=op)
    assert depth.shape == (16, 16)
    assert (depth == expected).all()


@pytest.mark.parametrize("backend", ["reference", *BUILDS])
def test_a_tilted_splat_has_the_depths_of_a_plane(backend: str) -> None:
    tilts = torch.tensor([[0.0625, -0.125]])
    with use(backend) as op:
        depth = ops.median_depth(discs([0.9], [10.0]), listed(1), 16, 16, tilts=tilts, backend=op)
    offset = torch.arange(16) + 0.5 - 8.0
    nearness = 1.0 - 0.0625 * offset[None, :] + 0.125 * offset[:, None]
    beyond = nearness <= 1e-3  # behind the plane's horizon
    assert beyond.any()
    assert not beyond.all()
    torch.testing.assert_close(depth, torch.where(beyond, 0.0, 10.0 / nearness), rtol=1e-6, atol=0)


@pytest.mark.parametrize("backend", BUILDS)
@pytest.mark.parametrize("name", CASES)
def test_depth_is_the_definitions(name: str, backend: str) -> None:
    case = CASES[name]()
    projected, bins, tilts = fields_of(case)
    with use(backend) as op:
        depth = ops.median_depth(projected, bins, case.width, case.height, tilts=tilts, backend=op)
    agrees(name, case, depth, projected, bins, tilts)


@pytest.mark.parametrize("backend", ["reference", *BUILDS])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
def test_a_bad_tilt_takes_no_other_splats_pixels(backend: str, bad: float) -> None:
    case = CASES["discs"]()
    projected, bins, _ = fields_of(case)
    flat = torch.zeros(len(projected.depths), 2)
    marking, poisoned = flat.clone(), flat.clone()
    marking[3], poisoned[3] = (
        1e3,
        bad,
    )  # the first gives the pixels of this splat another depth than any other
    with use(backend) as op:
        clean, marked, spoilt = (
            ops.median_depth(projected, bins, case.width, case.height, tilts=each, backend=op)
            for each in (flat, marking, poisoned)
        )
    others = clean == marked
    assert others.any()
    assert not others.all()
    assert torch.equal(spoilt[others], clean[others])
    assert not spoilt.isnan().any()


@pytest.mark.parametrize("backend", ["reference", *BUILDS])
def test_another_transmittance_is_passed_elsewhere(backend: str) -> None:
    splats, lists = discs([0.2, 0.4, 0.9], [1.0, 2.0, 3.0]), listed(3)  # 0.8, 0.48 and 0.048 are left
    with use(backend) as op:
        for transmittance, depth in ((0.9, 1.0), (0.7, 2.0), (0.4, 3.0)):
            image = ops.median_depth(splats, lists, 16, 16, transmittance=transmittance, backend=op)
            assert (image == depth).all()


@pytest.mark.parametrize("transmittance", [0.0, 0.05, 1.5, float("nan")])
def test_a_transmittance_that_no_pixel_has_is_refused(transmittance: float) -> None:
    with pytest.raises(ValueError, match="transmittance"):
        ops.median_depth(discs([0.5], [1.0]), listed(1), 16, 16, transmittance=transmittance)


def test_tilts_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="tilts"):
        ops.median_depth(discs([0.5], [1.0]), listed(1), 16, 16, tilts=torch.zeros(1, 3))
