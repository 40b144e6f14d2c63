"""The Triton kernels against the float64 reference, forward and backward, on the shared cases.

Without a GPU they run in Triton's interpreter, which takes milliseconds for every splat of a tile: on fewer Gaussians,
and composite on smaller images with shorter segments, so that lists still have several. On a machine with a GPU,
`pytest -m gpu` runs the cases whole on it. The interpreter does not prove atomics under real concurrency, the
hardware's approximate exp2 and division, and that the compiler keeps what the source says.
"""

from __future__ import annotations

import math
import os
from dataclasses import replace

import pytest
import torch
from torch import Tensor

pytest.importorskip(
    "triton", reason="Triton comes with torch's GPU builds; pip install triton to prove the kernels here"
)

from splatmill_worker.kernels import ops, reference
from splatmill_worker.kernels.gpu import adam as gpu_adam
from splatmill_worker.kernels.gpu import bin as gpu_bin
from splatmill_worker.kernels.records import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN, Bins, Projected
from splatmill_worker.kernels.records import GROUPS as PARAMETERS
from splatmill_worker.kernels.reference.bin import _least as least_of
from splatmill_worker.kernels.reference.composite import _weights
from tests.support.kernels.cases import CASES, GROUPS, Case
from tests.support.kernels.median import agrees, fields_of
from tests.support.kernels.proof import filled

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # the interpreter's numpy, where NaN is the point
]
INTERPRETING = os.environ.get("TRITON_INTERPRET") == "1"
EPS = 2.0**-24
DEVICES = [
    pytest.param(
        "cpu",
        marks=pytest.mark.skipif(not INTERPRETING, reason="a GPU is here; TRITON_INTERPRET=1 runs this"),
    ),
    pytest.param(
        "cuda",
        marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")],
    ),
]
BY_CASE = pytest.mark.parametrize("name", list(CASES))
BY_DEVICE = pytest.mark.parametrize("device", DEVICES)


def case_for(name: str, device: str, most: int) -> Case:
    """The case; for the interpreter with at most `most` Gaussians, spread over its list."""
    case = CASES[name]()
    n = len(case.means)
    if device == "cuda" or n <= most:
        return case
    rows = torch.linspace(0, n - 1, most).round().long()
    return replace(case, **{group: getattr(case, group)[rows] for group in GROUPS})


def shrunk(case: Case, device: str) -> Case:
    """The case; for the interpreter on three by two tiles at most, the last ones partly outside the image."""
    width, height = min(case.width, 40), min(case.height, 24)
    if device == "cuda":
        return case
    K = case.K.clone()
    K[0] *= width / case.width
    K[1] *= height / case.height
    return replace(case, K=K, width=width, height=height)


def ways(device: str) -> list[tuple[torch.dtype, ops.Backend, str]]:
    """The definition, the definition in the kernels' arithmetic, and the kernels."""
    return [
        (torch.float64, "reference", "cpu"),
        (torch.float32, "reference", "cpu"),
        (torch.float32, "gpu", device),
    ]


def project(
    case: Case, dtype: torch.dtype, backend: ops.Backend, device: str = "cpu"
) -> tuple[Projected, list[Tensor]]:
    """Fields and the leaves that gradients are asked for."""
    leaves = [x.to(device).requires_grad_() for x in case.groups(dtype)]
    viewmat = case.viewmat.to(device, dtype).clone().requires_grad_()
    return case.project(leaves, viewmat, backend), [*leaves, viewmat]


def close(
    name: str, result: Tensor, plain: Tensor, exact: Tensor, *, slack: float = 8.0, roundings: float = 64
) -> None:
    """`result` is as near to `exact` (float64) as the reference's own arithmetic in float32 (`plain`) is,
    within `slack`.

    That is what float32 can give for this scene; a needle may lose all digits and an ordinary splat almost
    none. The floor of some roundings of the largest value covers sums in another order.
    """
    if not exact.numel():
        assert not result.numel()
        return
    result, plain, exact = (x.detach().cpu().double() for x in (result, plain, exact))
    floor = roundings * EPS * float(exact.abs().max())
    allowed = slack * float((plain - exact).abs().max()) + floor
    error = float((result - exact).abs().max())
    assert error <= allowed, (
        f"{name}: error {error:.3g} where {allowed:.3g} is allowed, largest {exact.abs().max():.3g}"
    )


@BY_DEVICE
@BY_CASE
def test_project_agrees_with_the_definition(name: str, device: str) -> None:
    case = case_for(name, device, 40)
    exact, _ = project(case, torch.float64, "reference")
    plain, _ = project(case, torch.float32, "reference")
    projected, _ = project(case, torch.float32, "gpu", device)
    shown = projected.extents[:, 0].cpu() > 0
    # Who is culled may differ only where float32 itself is undecided.
    assert torch.equal(shown, exact.extents[:, 0] > 0) or torch.equal(shown, plain.extents[:, 0] > 0)
    both = shown & (exact.extents[:, 0] > 0) & (plain.extents[:, 0] > 0)
    for field, a, b, c in zip(Projected._fields, projected, plain, exact, strict=True):
        close(field, a.cpu()[both], b[both], c[both])
        assert not a.cpu()[~shown].any(), f"{field}: a culled row is not zero"


@BY_DEVICE
@BY_CASE
def test_gradient_of_project_agrees_with_the_definition(name: str, device: str) -> None:
    case = case_for(name, device, 40)
    weights: list[Tensor] | None = None
    gradients = []
    for dtype, backend, where in ways(device):
        fields, leaves = project(case, dtype, backend, where)
        if weights is None:
            g = torch.Generator().manual_seed(5)
            weights = [torch.randn(f.shape, generator=g, dtype=torch.float64) for f in fields[:5]]
            weights[1] *= fields[1].detach().abs().clamp_min(1e-3) ** -1  # conics range over many decades
        total = sum((f * w.to(where, dtype)).sum() for f, w in zip(fields[:5], weights, strict=True))
        assert isinstance(total, Tensor)
        if total.requires_grad:
            total.backward()
        gradients.append([torch.zeros_like(x) if x.grad is None else x.grad for x in leaves])
        culled = fields.extents[:, 0].cpu() == 0
        for group, gradient in zip(GROUPS, gradients[-1], strict=False):
            assert not gradient.cpu()[culled].any(), f"{group}: a culled row has a gradient"
    for group, a, b, c in zip((*GROUPS, "viewmat"), gradients[2], gradients[1], gradients[0], strict=True):
        close(group, a, b, c)


def single(fields: Projected, device: str) -> Projected:
    return Projected(*(x.detach().float().to(device) for x in fields))


@BY_DEVICE
@BY_CASE
def test_bin_agrees_with_the_definition_but_for_real_crossings(name: str, device: str) -> None:
    case = case_for(name, device, 40)
    fields = single(project(case, torch.float64, "reference")[0], "cpu")
    exact = reference.bin(Projected(*(x.double() for x in fields)), case.width, case.height)
    lists = ops.bin(single(fields, device), case.width, case.height, backend="gpu")
    columns = -(-case.width // TILE)
    expected, got = ({*pairs(exact)}, {*pairs(lists)})
    for tile, i in expected ^ got:
        a, b, c = fields.conics[i].double().tolist()
        mx, my = fields.means2d[i].double().tolist()
        xs = [tile % columns * TILE + e - mx for e in (0.5, TILE - 0.5)]
        ys = [tile // columns * TILE + e - my for e in (0.5, TILE - 0.5)]
        x, y = max(map(abs, xs)), max(map(abs, ys))
        size = a * x * x + 2 * abs(b) * x * y + c * y * y  # what the quadratic form's terms cancel from
        level = 2 * torch.log(fields.opacities[i].double() * 255).item()
        within = 64 * EPS * (size + abs(level) + 1)
        least = _least(fields.conics[i].double(), xs, ys)
        if (tile, i) in got:
            within += margin(fields, i, columns * TILE, -(-case.height // TILE) * TILE)
        assert abs(least - level) <= within, f"pair {tile}, {i}: {least} against {level}"
    order = [i for _, i in pairs(lists) if (_, i) in expected]
    assert order == [i for _, i in pairs(exact) if (_, i) in got]


@BY_DEVICE
def test_a_large_image_has_tiles_to_its_last_corner(device: str) -> None:
    """More tiles than 16 bits number, and a splat that touches more of them than are tested at a time."""
    width, height = 3000, 2990
    sigma = torch.tensor([3.0, 30.0, 5.0], dtype=torch.float64)
    opacities = torch.full((3,), 0.9, dtype=torch.float64)
    half = sigma * torch.sqrt(2 * torch.log(opacities * 255))
    fields = Projected(
        means2d=torch.tensor([[2991.0, 2985.0], [2800.0, 2700.0], [8.0, 8.0]], dtype=torch.float64),
        conics=torch.stack([sigma**-2, torch.zeros(3, dtype=torch.float64), sigma**-2], dim=1),
        opacities=opacities,
        colors=torch.ones(3, 3, dtype=torch.float64),
        depths=torch.tensor([3.0, 2.0, 1.0], dtype=torch.float64),
        extents=torch.stack([half, half], dim=1),
    )
    expected = pairs(reference.bin(fields, width, height))
    got = pairs(ops.bin(single(fields, device), width, height, backend="gpu"))
    assert -(-width // TILE) * -(-height // TILE) > gpu_bin.SHORT_TILES
    assert max(tile for tile, _ in expected) > gpu_bin.SHORT_TILES
    assert sum(i == 1 for _, i in expected) > gpu_bin.LANES
    assert got == expected


def margin(fields: Projected, i: int, width: int, height: int) -> float:
    """What the lists of an image of whole tiles add to the level of d^T C d, so that rounding loses no pair."""
    plain, per_term = (float(getattr(x, "value", x)) for x in (gpu_bin.MARGIN, gpu_bin.MARGIN_PER_TERM))
    a, b, _ = fields.conics[i].double().tolist()
    ux = math.sqrt(a / (2 * math.log(2)))
    uy = b / (2 * math.log(2) * ux)
    most = [
        min(extent, max(at, side - at))
        for extent, at, side in zip(
            fields.extents[i].tolist(), fields.means2d[i].tolist(), (width, height), strict=True
        )
    ]
    return float(2 * math.log(2) * (plain + per_term * (ux * most[0] + abs(uy) * most[1])))


def _least(conic: Tensor, xs: list[float], ys: list[float]) -> float:
    """The smallest value of the form over a rectangle, by the definition's own code."""
    center = torch.tensor([[0.5 - xs[0], 0.5 - ys[0]]], dtype=torch.float64)
    zero = torch.zeros(1, dtype=torch.int64)
    return float(least_of(conic[None], center, zero, zero))


def pairs(bins: Bins) -> list[tuple[int, int]]:
    offsets, ids = bins.offsets.tolist(), bins.ids.tolist()
    return [(t, i) for t in range(len(offsets) - 1) for i in ids[offsets[t] : offsets[t + 1]]]


def undecided(fields: Projected, bins: Bins, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Pixels [H, W] where a list comes within float32's reach of 1/255 or of the stop, and a bound of the
    image's error there.

    With d the rounding of the exponent, 8 eps (|a| x^2 + 2 |b x y| + |c| y^2) / 2, the image is off by at
    most 2 max(c) sum_i w_i d_i: once for the splat's own weight and once for what is behind it, which weighs
    no more.
    """
    near = torch.zeros(height, width, dtype=torch.bool)
    bound = torch.zeros(height, width, dtype=torch.float64)
    offsets, columns = bins.offsets.tolist(), -(-width // TILE)
    exact = Projected(*(x.double() for x in fields))
    for tile in range(len(offsets) - 1):
        ids = bins.ids[offsets[tile] : offsets[tile + 1]].long()
        if not len(ids):
            continue
        left, top = tile % columns * TILE, tile // columns * TILE
        w, h = min(TILE, width - left), min(TILE, height - top)
        weights = _weights(exact, ids, left, top, w, h, False)
        y, x = torch.meshgrid(
            torch.arange(top, top + h) + 0.5, torch.arange(left, left + w) + 0.5, indexing="ij"
        )
        dx = x.reshape(-1, 1).double() - exact.means2d[ids, 0]
        dy = y.reshape(-1, 1).double() - exact.means2d[ids, 1]
        a, b, c = exact.conics[ids].unbind(1)
        alpha = (
            exact.opacities[ids] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        ).clamp_max(0.999)
        d = 8 * EPS * (1 + 0.5 * (a * dx * dx + c * dy * dy) + (b * dx * dy).abs())
        after = torch.cumprod(torch.where(alpha >= ALPHA_MIN, 1 - alpha, 1.0), 1)
        drift = torch.cumsum(d * alpha / (1 - alpha), 1) + 8 * EPS * len(ids)
        close_cut = (alpha / ALPHA_MIN - 1).abs() <= d + 8 * EPS
        close_stop = (after / TRANSMITTANCE_MIN - 1).abs() <= drift
        near[top : top + h, left : left + w] = (close_cut | close_stop).any(1).reshape(h, w)
        bound[top : top + h, left : left + w] = ((weights * d).sum(1) + 2 * EPS * len(ids)).reshape(h, w)
    return near, bound


SEEN_BY_PROJECTION = {
    "degree 0",
    "degree 1",
    "degree 2",
    "dark",
    "principal point off centre",
    "sub-pixel antialias",
    "needles 1e+02",
}
"""Cases whose point is over once they are projected: on the device they run all the same, in the
interpreter they cost seconds.
"""


@BY_DEVICE
@BY_CASE
def test_composite_and_its_gradient_agree_with_the_definition(
    name: str, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if device == "cpu" and name in SEEN_BY_PROJECTION:
        pytest.skip("nothing new for compositing in this case; it runs on a GPU")
    case = shrunk(case_for(name, device, 9), device)
    if device == "cpu":
        for module in ("composite", "composite_backward"):
            monkeypatch.setattr(f"splatmill_worker.kernels.gpu.{module}.SEGMENT", 4)
    width, height = case.width, case.height
    fields = single(project(case, torch.float64, "reference")[0], "cpu")
    bins = reference.bin(Projected(*(x.double() for x in fields)), width, height)
    near, bound = undecided(fields, bins, width, height)
    g = torch.Generator().manual_seed(2)
    # At undecided pixels float32 may rightly take another branch: no gradient is sent there.
    weights = [
        torch.randn(height, width, *more, generator=g, dtype=torch.float64)
        * (~near).reshape(height, width, *[1] * len(more))
        for more in ((3,), (), ())
    ]
    images, gradients = [], []
    for dtype, backend, where in ways(device):
        leaves = [x.to(where, dtype).clone().requires_grad_() for x in fields[:5]]
        background = case.background.to(where, dtype).clone().requires_grad_()
        lists = Bins(bins.offsets.to(where), bins.ids.to(where))
        image = ops.composite(
            filled(fields, leaves), lists, width, height,
            background=background, backend=backend,
        )  # fmt: skip
        total = sum((part * w.to(where, dtype)).sum() for part, w in zip(image, weights, strict=True))
        assert isinstance(total, Tensor)
        total.backward()
        images.append([x.detach().cpu().double() for x in image])
        gradients.append([torch.zeros_like(x) if x.grad is None else x.grad for x in (*leaves, background)])
    # What is behind a splat is a difference of two sums over three channels, rounded as they are, and is divided by
    # 1 - alpha. A GPU fuses products and sums as it likes, in one kernel otherwise than in the other: four roundings.
    opaque = min(ALPHA_MAX, float(fields.opacities.max())) if len(fields.opacities) else 0.0
    amplified = 4 / (1 - opaque)
    tops = (
        max(1.0, float(fields.colors.max()) if len(fields.colors) else 0.0),
        1.0,
        max(1.0, float(fields.depths.max()) if len(fields.depths) else 0.0),
    )
    for part, result, exact, top in zip(("color", "alpha", "depth"), images[2], images[0], tops, strict=True):
        allowed = (2 * top * bound + 4 * EPS * top).reshape(height, width, *[1] * (exact.dim() - 2))
        worst = ((result - exact).abs() / allowed).masked_fill(
            near.reshape(height, width, *[1] * (exact.dim() - 2)), 0
        )
        assert float(worst.max()) <= 1, f"{part}: {float(worst.max()):.3g} of what is allowed"
    for field, a, b, c in zip(
        (*Projected._fields[:5], "background"), gradients[2], gradients[1], gradients[0], strict=True
    ):
        close(field, a, b, c, slack=16, roundings=max(64, amplified))


@BY_DEVICE
@pytest.mark.parametrize("name", ["discs", "a block and one", "near plane", "antialias"])
def test_median_depth_agrees_with_the_definition(name: str, device: str) -> None:
    case = shrunk(case_for(name, device, 40), device)
    projected, bins, tilts = fields_of(case)
    depth = ops.median_depth(
        single(projected, device), Bins(bins.offsets.to(device), bins.ids.to(device)), case.width, case.height,
        tilts=tilts.to(device), backend="gpu",
    )  # fmt: skip
    assert (depth > 0).any()
    agrees(name, case, depth.cpu(), projected, bins, tilts)


BAD = (float("nan"), float("inf"), float("-inf"), 3.4e38, 1e-45)


@BY_DEVICE
@pytest.mark.parametrize("group", GROUPS)
def test_a_bad_number_culls_its_gaussian_and_touches_no_other(group: str, device: str) -> None:
    """Every bad number in a Gaussian of its own, in the first and in the last slot of the group."""
    case = case_for("a block and one", device, 17)
    clean, _ = project(case, torch.float32, "gpu", device)
    victims = torch.arange(3, 3 + 2 * len(BAD), 2)
    others = ~torch.isin(torch.arange(17), victims)
    for slot in {0, getattr(case, group)[0].numel() - 1}:
        poisoned = getattr(case, group).clone()
        poisoned.view(17, -1)[victims, slot] = torch.tensor(BAD)
        projected, _ = project(replace(case, **{group: poisoned}), torch.float32, "gpu", device)
        for field, a, b in zip(Projected._fields, projected, clean, strict=True):
            assert torch.equal(a.cpu()[others], b.cpu()[others]), f"{group}[{slot}] changed another's {field}"
            assert torch.isfinite(a).all(), f"{group}[{slot}] left {field} not finite"
        for victim, value in zip(victims.tolist(), BAD, strict=True):
            if not abs(value) < float("inf"):
                assert not projected.extents[victim].any(), f"{group}[{slot}] = {value} was not culled"


@BY_DEVICE
def test_a_gaussian_on_the_near_plane_is_culled(device: str) -> None:
    case = case_for("a block and one", device, 17)
    near = torch.tensor(case.near)
    beyond = torch.nextafter(near, torch.tensor(1.0))
    means = torch.zeros_like(case.means)
    means[:, 2] = torch.where(torch.arange(len(means)) % 2 == 0, near, beyond)
    case = replace(
        case, means=means, viewmat=torch.eye(4), log_scales=torch.full_like(case.log_scales, -6.0),
        logit_opacities=torch.zeros_like(case.logit_opacities),
    )  # fmt: skip
    drawn = (project(case, torch.float32, "gpu", device)[0].extents > 0).all(1)
    assert torch.equal(drawn.cpu(), means[:, 2] == beyond)


@BY_DEVICE
@pytest.mark.parametrize("length", [1e-30, 1e30])
def test_the_length_of_a_quaternion_does_not_matter(length: float, device: str) -> None:
    case = case_for("a block and one", device, 17)
    plain, _ = project(case, torch.float32, "gpu", device)
    projected, _ = project(replace(case, quats=case.quats * length), torch.float32, "gpu", device)
    assert plain.extents.any()
    for field, a, b in zip(Projected._fields, projected, plain, strict=True):
        # The product with a power of ten rounds each component once.
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4 * b.detach().abs().max().item(), msg=field)


@BY_DEVICE
@pytest.mark.parametrize(
    ("height", "width", "masked", "kept"),
    [(20, 24, True, False), (17, 16, False, True), (1, 1, False, False), (1, 35, True, True)],
)
def test_loss_and_its_gradient_agree_with_the_definition(
    height: int, width: int, masked: bool, kept: bool, device: str
) -> None:
    g = torch.Generator().manual_seed(height)
    photo = torch.randint(0, 256, (height, width, 3), generator=g, dtype=torch.uint8)
    photo[: height // 2] = 255  # a saturated part: its variance is a difference of equal numbers
    color = torch.rand(height, width, 3, generator=g) * 1.2 - 0.1
    mask = (torch.rand(height, width, generator=g) < 0.7) if masked else None
    results = []
    for dtype, backend, where in ways(device):
        x = color.to(where, dtype).clone().requires_grad_()
        here, used = photo.to(where), None if mask is None else mask.to(where)
        stats = ops.photo_stats(here, mask=used, backend=backend) if kept and dtype == torch.float32 else None
        value = ops.loss(x, here, dssim_weight=0.3, mask=used, stats=stats, backend=backend)
        value.backward()
        assert x.grad is not None
        results.append((value.detach()[None], x.grad))
    for part, a, b, c in zip(("value", "gradient"), results[2], results[1], results[0], strict=True):
        close(part, a, b, c)


@BY_DEVICE
def test_loss_with_no_used_pixel_is_zero(device: str) -> None:
    color = torch.rand(5, 7, 3, device=device).requires_grad_()
    photo = torch.zeros(5, 7, 3, dtype=torch.uint8, device=device)
    value = ops.loss(color, photo, mask=torch.zeros(5, 7, dtype=torch.bool, device=device), backend="gpu")
    value.backward()
    assert value.item() == 0
    assert color.grad is not None
    assert not color.grad.any()


@BY_DEVICE
@pytest.mark.parametrize("beta2", [0.999, 0.98])
def test_adam_agrees_with_the_definition(beta2: float, device: str) -> None:
    """Steps on planes, of which some Gaussians miss one, five, or tens of thousands; two gradients are refused."""
    random = torch.Generator().manual_seed(1)
    rates = [1e-2, 5e-3, 1e-3, 5e-2, 2.5e-3, 1e-4]
    sizes = [*list(PARAMETERS.values())[:-1], 3, 45]
    start = torch.randn(59, 37, generator=random)
    steps = [
        (torch.randn(59, 37, generator=random) * 10.0**-k, torch.rand(37, generator=random) < 0.5)
        for k in range(7)
    ]
    steps[2][0][1, steps[2][1].nonzero()[0]] = float("nan")
    steps[3][0][10, steps[3][1].nonzero()[1]] = 1e30  # its square is not finite
    ends, refusals = [], []
    for dtype, backend, where in ways(device):
        params = start.to(where, dtype).clone()
        m, v = torch.zeros_like(params), torch.zeros_like(params)
        last, refused = (torch.zeros(n, dtype=torch.int32, device=where) for n in (37, 1))
        for number, (gradient, shown) in zip((1, 2, 3, 8, 9, 5001, 30001), steps, strict=True):
            grads, visible = gradient.to(where, dtype), shown.to(where)
            if backend == "gpu":
                missed = gpu_adam.CatchUp(visible.to(torch.uint8), last, number, beta2)
                gpu_adam.apply_planes(params, grads, m, v, rates, 59, number, beta2, refused, missed)
                continue
            # float64 holds the square of 1e30; the definition's rule is about float32's.
            grads = grads.where(grads.abs() < 1e19, torch.inf)
            p, g, m1, v1 = ([x.t() for x in part.split(sizes)] for part in (params, grads, m, v))
            late = {"visible": visible, "last_step": last}
            refused += reference.adam_(p, g, m1, v1, rates, step=number, beta2=beta2, **late)
        ends.append([*(x for part in (params, m, v) for x in part.split(sizes)), last])
        refusals.append(int(refused))
    assert refusals == [2, 2, 2]
    for i, (a, b, c) in enumerate(zip(ends[2], ends[1], ends[0], strict=True)):
        close(f"state {i}", a, b, c)


@BY_DEVICE
@pytest.mark.parametrize("n", [2, 3, 65, 130])
def test_knn_agrees_with_the_definition(n: int, device: str) -> None:
    points = torch.randn(n, 3, generator=torch.Generator().manual_seed(n))
    points[n // 2 :: 7] = points[0]  # duplicates are other points at distance 0
    exact = reference.knn(points.double())
    distances = ops.knn(points.to(device), backend="gpu").cpu().double()
    # A distance is the root of three squares: four roundings, each of half an ulp, on differences that are
    # exact to one.
    assert float(((distances - exact).abs() - 8 * EPS * (exact + points.abs().max())).max()) <= 0
