"""Correlation of patches with another image: the definition by hand and against torch's grid_sample, and every build
against the definition in float64, with cameras that turn, see behind themselves, and look past their borders.

Says nothing about speed, nor whether correlated patches show the same thing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from tests.support.kernels.bounds import at_most
from tests.support.kernels.proof import EPS, backends, use

MARGIN, FLOOR = 3.0, 1e-4
BUILDS = [b for b in backends() if str(b).startswith("cpu")]


@dataclass(frozen=True)
class Search:
    """The arguments of the op: image [H,W], rays [N,M,3], patches [N,M], inverse depths [D], turn [3,3], shift [3]."""

    image: Tensor
    rays: Tensor
    patches: Tensor
    inverse_depths: Tensor
    turn: Tensor
    shift: Tensor

    def tensors(self, dtype: torch.dtype = torch.float32) -> tuple[Tensor, ...]:
        fields = (self.image, self.rays, self.patches, self.inverse_depths, self.turn, self.shift)
        return tuple(x.to(dtype) for x in fields)


def _search(kind: str) -> Search:
    """Patches of 7x7 pixels of a camera of 64x48 pixels, and the same camera moved."""
    g = torch.Generator().manual_seed(4)
    height, width, focal, side, count, depths = 48, 64, 60.0, 7, 40, 37
    turn, shift = torch.eye(3), torch.tensor([0.4, 0.1, 0.05])
    image = torch.rand(height, width, generator=g)
    inverse = torch.linspace(0.05, 2.0, depths)
    if kind == "turned":
        a = torch.tensor(0.2)
        turn = torch.tensor([[a.cos(), 0, a.sin()], [0, 1, 0], [-a.sin(), 0, a.cos()]])
    elif kind == "towards the camera":
        shift = torch.tensor([0.1, 0.0, -1.2])
    elif kind == "behind":
        turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    elif kind == "flat":
        image = 0.5 + 1e-4 * image
    elif kind == "one colour":
        image = torch.full_like(image, 0.7)
    elif kind == "four pixels":
        image = image[:2, :2].contiguous()
    elif kind == "one depth":
        inverse = inverse[9:10]
    elif kind == "seventeen depths":
        inverse = inverse[:17]
    elif kind == "one point each":
        side = 1
    elif kind == "bright":
        image = 300.0 + 5.0 * image
    height, width = image.shape
    centre = torch.rand(count, 1, 2, generator=g) * torch.tensor([64.0, 48.0])
    offsets = torch.cartesian_prod(*[torch.arange(side) - side // 2] * 2).flip(1).float()
    pixels = centre + offsets
    rays = torch.cat([(pixels - torch.tensor([32.0, 24.0])) / focal, torch.ones(count, side**2, 1)], 2)
    patches = torch.randn(count, side**2, generator=g)
    patches = patches - patches.mean(1, keepdim=True)
    patches = patches / patches.norm(dim=1, keepdim=True).clamp_min(1e-6)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Search(image, rays, patches, inverse, K @ turn, K @ shift)


KINDS = ["shifted", "turned", "towards the camera", "behind", "flat", "one colour", "four pixels", "one depth",
         "seventeen depths", "one point each", "bright"]  # fmt: skip


def correlate(search: Search, backend: str, dtype: torch.dtype = torch.float32) -> Tensor:
    with use(backend) as op:
        return ops.correlate(*search.tensors(dtype), margin=MARGIN, least_variance=FLOOR, backend=op)


@dataclass(frozen=True)
class Exact:
    """The definition in float64: scores [N,D], how far float32 may be from them, and which it may show or not."""

    scores: Tensor
    allowed: Tensor
    either: Tensor


@cache
def exact(kind: str) -> Exact:
    search = _search(kind)
    image, rays, patches, inverse, turn, shift = search.tensors(torch.float64)
    height, width = image.shape
    count, middle = rays.shape[1], rays.shape[1] // 2
    points = (rays @ turn.T)[:, None] + (inverse[:, None] * shift)[:, None]
    terms = (rays.abs() @ turn.T.abs())[:, None] + (inverse[:, None] * shift.abs())[:, None]
    off = 4 * EPS * terms  # three products, two sums and the motion, each rounded once
    z = points[..., 2].clamp_min(1e-6)
    pixels = points[..., :2] / z[..., None]
    # The numerator's error, that of the depth, and two roundings of the quotient; one more takes half a pixel away.
    moved = off[..., :2] / z[..., None] + pixels.abs() * (off[..., 2] / z + 3 * EPS)[..., None] + EPS
    grid = 2 * pixels / torch.tensor([width, height]) - 1
    n, d, m, _ = grid.shape
    samples = torch.nn.functional.grid_sample(
        image[None, None], grid.reshape(1, n * d, m, 2), padding_mode="border", align_corners=False
    ).reshape(n, d, m)
    steps = [image.diff(dim=axis).abs().max() for axis in (0, 1)]
    wrong = max(steps) * moved.sum(-1).clamp_max(width + height) + 6 * EPS * image.abs().max()
    mean = samples.mean(-1, keepdim=True)
    deviation = (samples - mean).square().mean(-1).clamp_min(FLOOR).sqrt()
    scores = ((samples - mean) * patches[:, None]).sum(-1) / (deviation * count**0.5)
    # Through the product and through the deviation, the largest error of a sample; then the rounding of their sums.
    spread = (samples - samples[:, :, middle, None]).abs().amax(-1) / deviation
    allowed = 2 * wrong.amax(-1) / deviation + (count + 8) * EPS * (spread + 2 * spread**2) + 8 * EPS
    # The mean of a patch is 0 but for rounding, so that it does not matter from where its grey values count.
    allowed += patches.sum(1).abs()[:, None] * spread / count**0.5
    x, y = pixels[:, :, middle].unbind(-1)
    shown = (points[:, :, middle, 2] > 1e-6) & (x > MARGIN) & (x < width - MARGIN)
    shown &= (y > MARGIN) & (y < height - MARGIN)
    at_border = [(v - b).abs() for v, side in ((x, width), (y, height)) for b in (MARGIN, side - MARGIN)]
    either = torch.stack(at_border).amin(0) <= moved[:, :, middle].amax(-1)
    ahead, by = points[:, :, middle, 2] - 1e-6, off[:, :, middle, 2]
    either = (either & (ahead > -by)) | (ahead.abs() <= by)
    return Exact(torch.where(shown, scores, -1.0), allowed, either)


@pytest.mark.parametrize("kind", KINDS)
def test_the_definition_is_that_of_grid_sample(kind: str) -> None:
    want = exact(kind)
    got = correlate(_search(kind), "reference", torch.float64)
    assert float((got - want.scores).abs()[~want.either].max()) < 1e-9


@pytest.mark.parametrize("backend", BUILDS)
@pytest.mark.parametrize("kind", KINDS)
def test_scores_are_the_definitions(kind: str, backend: str) -> None:
    want = exact(kind)
    error = (correlate(_search(kind), backend).double() - want.scores).abs()
    # A tenth of what would be if all roundings went the same way: measured 0.03.
    at_most("correlate", kind, error[~want.either], 0.1 * want.allowed[~want.either])
    assert float(want.either.double().mean()) < 0.01


@pytest.mark.parametrize("backend", ["reference", *BUILDS])
def test_a_patch_is_found_where_it_is(backend: str) -> None:
    """The camera steps aside by one unit: at the inverse depth w, a pixel is w focal lengths further left."""
    g = torch.Generator().manual_seed(5)
    image, focal = torch.rand(32, 64, generator=g), 8.0
    rows, columns = torch.meshgrid(torch.arange(12, 19), torch.arange(20, 27), indexing="ij")
    patch = image[rows, columns].flatten() - image[rows, columns].mean()
    there = torch.stack([(columns + 0.5 - 32) / focal + 1.0, (rows + 0.5 - 16) / focal, torch.ones(7, 7)], -1)
    K = torch.tensor([[focal, 0, 32.0], [0, focal, 16.0], [0, 0, 1.0]])
    search = Search(
        image, there.reshape(1, 49, 3).float(), (patch / patch.norm())[None],
        torch.tensor([0.5, 0.75, 1.0, 1.25, 9.0]), K, K @ torch.tensor([-1.0, 0, 0]),
    )  # fmt: skip
    scores = correlate(search, backend)[0]
    assert float(scores[2]) == pytest.approx(1.0, abs=1e-5)
    assert float(scores[:2].max()) < 0.8
    assert float(scores[3]) < 0.8
    assert float(scores[4]) == -1.0


@pytest.mark.parametrize("backend", ["reference", *BUILDS])
def test_what_is_behind_the_camera_is_not_seen_where_its_line_passes(backend: str) -> None:
    ray = torch.tensor([32e-6, 24e-6, -1.0])
    patches = _search("shifted").patches[:1]
    search = Search(
        torch.rand(48, 64), ray.repeat(1, 49, 1), patches, torch.zeros(3), torch.eye(3), torch.zeros(3)
    )
    assert correlate(search, backend).tolist() == [[-1.0] * 3]


@pytest.mark.parametrize("backend", BUILDS)
def test_threads_do_not_show(backend: str) -> None:
    search = _search("turned")
    before, scores = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            scores.append(correlate(search, backend))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*scores)


@pytest.mark.parametrize("backend", ["reference", *BUILDS])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e38])
def test_a_bad_ray_spoils_its_own_patch_alone(backend: str, value: float) -> None:
    search = _search("shifted")
    good = correlate(search, backend)
    search.rays[3] = value
    bad = correlate(search, backend)
    others = torch.arange(len(good)) != 3
    assert torch.equal(good[others], bad[others])


@pytest.mark.parametrize("backend", ["reference", *BUILDS])
def test_no_patches_and_no_depths_give_no_scores(backend: str) -> None:
    image, rays, patches, inverse, turn, shift = _search("shifted").tensors()
    none = Search(image, rays[:0], patches[:0], inverse, turn, shift)
    assert correlate(none, backend).shape == (0, 37)
    assert correlate(Search(image, rays, patches, inverse[:0], turn, shift), backend).shape == (40, 0)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"image": torch.zeros(1, 9)}, "image"),
        ({"image": torch.zeros(9, 9, dtype=torch.float64)}, "image"),
        ({"rays": torch.zeros(40, 48, 3)}, "patches"),
        ({"rays": torch.zeros(2, 4, 3), "patches": torch.zeros(2, 4)}, "rays"),
        ({"inverse_depths": torch.zeros(2, 2)}, "inverse_depths"),
        ({"turn": torch.zeros(3)}, "turn"),
        ({"shift": torch.zeros(4)}, "shift"),
        ({"margin": -1.0}, "margin"),
        ({"least_variance": 0.0}, "least_variance"),
        ({"margin": float("nan")}, "margin"),
    ],
)
def test_bad_arguments_are_named(change: dict[str, Any], names: str) -> None:
    search = _search("shifted")
    arguments = {
        "image": search.image, "rays": search.rays, "patches": search.patches, "turn": search.turn,
        "inverse_depths": search.inverse_depths, "shift": search.shift, "margin": MARGIN, "least_variance": FLOOR,
    }  # fmt: skip
    with pytest.raises((TypeError, ValueError), match=names):
        ops.correlate(**{**arguments, **change}, backend="cpu")
