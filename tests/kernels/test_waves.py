"""Waves: by hand, the definition's gradient, and every build against the definition, in values and in gradients.

Also proven: a Gaussian without a wave has the bits of composite without waves; a bad wave is left out and changes no
other pixel; thread numbers change nothing; the fused step has the op's gradient. Not proven: what fits them
(tests/worker/fit_image).
"""

from __future__ import annotations

import importlib
import math

import pytest
import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import NYQUIST, Bins, Projected, Rates, Waves
from tests.support.kernels.bounds import at_most
from tests.support.kernels.proof import EPS, backends, filled, use

BUILDS = [b for b in backends() if str(b).startswith("cpu")]
WIDTH, HEIGHT = 40, 36


def scene(count: int, seed: int = 0, wide: float = 5.0) -> tuple[Projected, Waves]:
    """Gaussians over and beside the image, alphas away from the clamp, half of them with waves, in float64."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    means = (rand(count, 2) * 1.4 - 0.2) * torch.tensor([WIDTH, HEIGHT])
    sigma = wide * (0.3 + rand(count, 2))
    lean = 1.6 * rand(count) - 0.8  # correlation
    det = (1 - lean * lean) * sigma[:, 0] ** 2 * sigma[:, 1] ** 2
    conics = (
        torch.stack([sigma[:, 1] ** 2, -lean * sigma[:, 0] * sigma[:, 1], sigma[:, 0] ** 2], 1) / det[:, None]
    )
    opacities = 0.05 + 0.75 * rand(count)
    reach = (2 * torch.log(255 * opacities)).sqrt()
    projected = Projected(means, conics, opacities, rand(count, 3), 1 + rand(count), reach[:, None] * sigma)
    # Rounded to float32, so that the definition is given what the backends are given.
    projected = Projected(*(field.float().double() for field in projected))
    rows = torch.full((count,), -1, dtype=torch.int32)
    rows[::2] = torch.randperm((count + 1) // 2, generator=g).to(torch.int32)
    waved = (count + 1) // 2
    values = torch.cat([0.7 * rand(waved, 2) - 0.35, 4 * rand(waved, 1) - 2, rand(waved, 3) - 0.5], 1)
    return projected, Waves(values.float().double(), rows)


def one(values: list[float]) -> tuple[Projected, Waves, Bins]:
    """A splat as wide as the 16 x 16 pixels, with alpha 1/2, centred at (8, 8)."""
    p = Projected(
        torch.full((1, 2), 8.0), torch.tensor([[1e-12, 0.0, 1e-12]]), torch.tensor([0.5]), torch.full((1, 3), 0.25),
        torch.ones(1), torch.full((1, 2), 1e6),
    )  # fmt: skip
    lists = Bins(torch.tensor([0, 1]), torch.zeros(1, dtype=torch.int32))
    return p, Waves(torch.tensor([values]), torch.zeros(1, dtype=torch.int32)), lists


@pytest.mark.parametrize("backend", ["reference", *BUILDS])
def test_a_wave_is_a_cosine_over_the_offset_from_the_centre(backend: str) -> None:
    p, waves, lists = one([0.125, 0.0625, 0.3, 1.0, -0.5, 0.0])
    with use(backend) as op:
        color, alpha, _ = ops.composite(p, lists, 16, 16, waves=waves, backend=op)
    d = torch.arange(16) + 0.5 - 8.0
    cosine = torch.cos(2 * math.pi * (0.125 * d[None, :] + 0.0625 * d[:, None] + 0.3))
    for channel, amplitude in enumerate((1.0, -0.5, 0.0)):
        want = 0.5 * (0.25 + amplitude * cosine)
        torch.testing.assert_close(color[..., channel], want, rtol=0, atol=1e-6)
    torch.testing.assert_close(alpha, torch.full((16, 16), 0.5))


def leaves_of(p: Projected, waves: Waves, dtype: torch.dtype) -> tuple[Projected, Waves, dict[str, Tensor]]:
    fields = {name: getattr(p, name).to(dtype).requires_grad_() for name in Projected._fields[:5]}
    values = waves.values.to(dtype).requires_grad_()
    return (
        filled(p, list(fields.values())),
        Waves(values, waves.rows),
        {**fields, "waves": values},
    )


def differentiated(
    p: Projected, waves: Waves, lists: Bins, backend: ops.Backend, dtype: torch.dtype
) -> list[Tensor]:
    """Colour, alpha, depth, and the gradients of a weighted sum of them to the fields and the waves."""
    p, waves, leaves = leaves_of(p, waves, dtype)
    images = ops.composite(
        p, lists, WIDTH, HEIGHT, background=torch.ones(3, dtype=dtype), waves=waves, backend=backend
    )
    g = torch.Generator().manual_seed(9)
    total = sum(
        ((x * torch.randn(x.shape, generator=g).to(dtype)).sum() for x in images),
        torch.zeros((), dtype=dtype),
    )
    return [x.detach() for x in images] + list(torch.autograd.grad(total, list(leaves.values())))


def test_the_definition_has_the_gradient_of_finite_differences() -> None:
    """gradcheck in float64, over the fields and the waves, without the cut at 1/255."""
    from splatmill_worker.kernels.reference.composite import composite

    p, waves = scene(6, seed=3)
    lists = ops.bin(p, WIDTH, HEIGHT, backend="reference")
    _, _, leaves = leaves_of(p, waves, torch.float64)

    def blend(*fields: Tensor) -> tuple[Tensor, ...]:
        moved = filled(p, fields[:5])
        image = composite(moved, lists, WIDTH, HEIGHT, waves=Waves(fields[5], waves.rows), _soft_cut=True)
        return tuple(x[::5, ::7] for x in image)

    assert torch.autograd.gradcheck(blend, tuple(leaves.values()), eps=1e-6, atol=1e-5)


@pytest.mark.parametrize("backend", BUILDS)
@pytest.mark.parametrize(("count", "wide"), [(1, 5.0), (40, 5.0), (200, 1.0), (1500, 3.0), (30, 60.0)])
def test_values_and_gradients_are_the_definitions(backend: str, count: int, wide: float) -> None:
    p, waves = scene(count, seed=count, wide=wide)
    lists = ops.bin(p, WIDTH, HEIGHT, backend="reference")
    want = differentiated(p, waves, lists, "reference", torch.float64)
    with use(backend) as op:
        got = differentiated(p, waves, lists, op, torch.float32)
    names = ("color", "alpha", "depth", *Projected._fields[:5], "waves")
    for name, a, b in zip(names, got, want, strict=True):
        # A phase has four roundings of up to a turn's 2 pi and the cosine's own 2.5e-7; alphas and sums some EPS for
        # each of up to 100 splats at a pixel. Gradients add up to 1500 pixels with weights near one.
        scale = float(b.abs().max()) + 1e-3
        at_most(name, f"waves {count}", (a.double() - b).abs(), 400 * EPS * scale)


@pytest.mark.parametrize("backend", BUILDS)
def test_without_a_wave_the_bits_are_those_of_composite(backend: str) -> None:
    p, waves = scene(60, seed=5)
    p = Projected(*(field.float() for field in p))
    lists = ops.bin(p, WIDTH, HEIGHT, backend="reference")
    none = Waves(waves.values.float(), torch.full_like(waves.rows, -1))
    with use(backend) as op:
        plain = ops.composite(p, lists, WIDTH, HEIGHT, backend=op)
        waved = ops.composite(p, lists, WIDTH, HEIGHT, waves=none, backend=op)
    for a, b in zip(plain, waved, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("backend", ["reference", *BUILDS])
@pytest.mark.parametrize("place", range(6))
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_bad_wave_is_left_out_and_nothing_else(backend: str, place: int, bad: float) -> None:
    p, waves = scene(20, seed=6)
    p = Projected(*(field.float() for field in p))
    lists = ops.bin(p, WIDTH, HEIGHT, backend="reference")
    poisoned = waves.values.float()
    poisoned[4, place] = bad
    poisoned.requires_grad_()
    without = torch.where(waves.rows == 4, -1, waves.rows)
    with use(backend) as op:
        got = ops.composite(p, lists, WIDTH, HEIGHT, waves=Waves(poisoned, waves.rows), backend=op)[0]
        want = ops.composite(p, lists, WIDTH, HEIGHT, waves=Waves(poisoned, without), backend=op)[0]
        (gradient,) = torch.autograd.grad(got.sum(), poisoned)
    assert torch.equal(got, want)
    assert (gradient[4] == 0).all()
    assert gradient.isfinite().all()
    assert (gradient.abs().sum(1) > 0).sum() >= 5


@pytest.mark.parametrize("backend", ["reference", *BUILDS])
def test_the_highest_frequency_is_drawn_and_none_beyond(backend: str) -> None:
    drawn = []
    for frequency in (NYQUIST, math.nextafter(NYQUIST, 1.0) + 1e-7, 1e30):
        p, waves, lists = one([frequency, 0.0, 0.25, 1.0, 1.0, 1.0])
        with use(backend) as op:
            drawn.append(ops.composite(p, lists, 16, 16, waves=waves, backend=op)[0])
    # Pixel centres are half a pixel from the centre of the splat, where cos(pi d + pi / 2) alternates between -1 and 1.
    column = torch.arange(16)
    want = 0.125 + 0.5 * torch.where(column % 2 == 0, 1.0, -1.0) * float(torch.sign(drawn[0][0, 0, 0]))
    assert torch.allclose(drawn[0][0, :, 0], want, atol=1e-6)
    for color in drawn[1:]:
        assert torch.allclose(color, torch.full((16, 16, 3), 0.125), atol=1e-7)


@pytest.mark.parametrize("backend", BUILDS)
def test_a_phase_of_a_million_turns_is_its_fraction(backend: str) -> None:
    shown = []
    for phase in (0.25, 1e6 + 0.25):
        p, waves, lists = one([0.1, 0.0, phase, 1.0, 1.0, 1.0])
        with use(backend) as op:
            shown.append(ops.composite(p, lists, 16, 16, waves=waves, backend=op)[0])
    torch.testing.assert_close(shown[0], shown[1], rtol=0, atol=1e-6)


@pytest.mark.parametrize("backend", BUILDS)
def test_the_number_of_threads_changes_no_bit(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    p, waves = scene(300, seed=8)
    lists = ops.bin(p, WIDTH, HEIGHT, backend="reference")
    results = []
    for threads in (1, 2, 5):
        with use(backend) as op:
            module = importlib.import_module("splatmill_worker.kernels.cpu.composite")

            class Engine:
                def __init__(self, engine: object, threads: int) -> None:
                    self.engine, self.threads = engine, threads

                def __getattr__(self, name: str) -> object:
                    return getattr(self.engine, name)

                def default_threads(self) -> int:
                    return self.threads

            with monkeypatch.context() as patch:
                patch.setattr(module, "engine", Engine(vars(module)["engine"], threads))
                results.append(differentiated(p, waves, lists, op, torch.float32))
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


@pytest.mark.parametrize("backend", BUILDS)
def test_rows_that_name_no_wave_or_one_twice_are_refused(backend: str) -> None:
    p, waves = scene(4)
    p = Projected(*(field.float() for field in p))
    lists = ops.bin(p, WIDTH, HEIGHT, backend="reference")
    for rows, told in (([0, 2, -1, -1], "there are 2 waves"), ([0, 0, -1, -1], "the wave of another")):
        bad = Waves(waves.values.float(), torch.tensor(rows, dtype=torch.int32))
        with use(backend) as op, pytest.raises(ValueError, match=told):
            ops.composite(p, lists, WIDTH, HEIGHT, waves=bad, backend=op)
    with pytest.raises(ValueError, match=r"waves\.rows"):
        ops.composite(
            p, lists, WIDTH, HEIGHT, waves=Waves(waves.values.float(), waves.rows[:2]), backend="cpu"
        )
    with pytest.raises(NotImplementedError, match="waves"):
        ops.composite(p, lists, WIDTH, HEIGHT, waves=waves, backend="gpu")


def parameters(count: int) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(1)
    means = torch.rand(count, 3, generator=g) - 0.5
    means[:, 2] = 1.0 - 1e-3 * torch.arange(count)
    return {
        "means": means,
        "log_scales": torch.randn(count, 3, generator=g) * 0.3 - 2.5,
        "quats": torch.randn(count, 4, generator=g),
        "logit_opacities": torch.randn(count, generator=g).clamp(-2, 1),
        "sh": torch.cat([torch.rand(count, 1, 3, generator=g), torch.zeros(count, 15, 3)], 1),
    }


@pytest.mark.parametrize("backend", BUILDS)
def test_the_fused_step_has_the_gradient_of_the_definition(backend: str) -> None:
    """Parameters and waves, with a Gaussian out of view whose wave has no gradient."""
    count = 33
    groups = parameters(count)
    groups["means"][6] = torch.tensor([50.0, 0.0, 1.0])
    _, waves = scene(count, seed=2)
    viewmat, K = torch.eye(4), torch.tensor([[40.0, 0, 20], [0, 40, 18], [0, 0, 1]])
    leaves = {name: value.double().requires_grad_() for name, value in groups.items()}
    m, s, q, o, h = leaves.values()
    values = waves.values.requires_grad_()
    p = ops.project(
        m,
        s,
        q,
        o,
        h,
        viewmat.double(),
        K.double(),
        WIDTH,
        HEIGHT,
        degree=0,
        backend="reference",
    )
    lists = ops.bin(p, WIDTH, HEIGHT, backend="reference")
    want = ops.composite(p, lists, WIDTH, HEIGHT, waves=Waves(values, waves.rows), backend="reference")[0]
    weight = torch.randn(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(4))
    gradients = torch.autograd.grad((want * weight).sum(), [*leaves.values(), values])
    means, scales, quats, logits, sh = groups.values()
    with use(backend):
        step = Step(means, scales, quats, logits, sh)
        step.waves = Waves(waves.values.detach().float(), waves.rows)
        color, _, _ = step.forward(viewmat, K, WIDTH, HEIGHT, degree=0)
        at_most("color", "waves, step", (color.double() - want.detach()).abs(), 4e-6)
        got = step.gradients(weight)
        for name, gradient in zip(leaves, gradients, strict=False):
            scale = float(gradient.abs().max()) + 1e-6
            at_most(name, "waves, step", (got[name].double() - gradient).abs(), 100 * EPS * scale)
        step.forward(viewmat, K, WIDTH, HEIGHT, degree=0)
        step.backward_update(weight, rates=Rates(0, 0, 0, 0, 0, 0), step=1)
    assert step.wave_gradient is not None
    at_most(
        "waves",
        "waves, step",
        (step.wave_gradient.double() - gradients[-1]).abs(),
        100 * EPS * float(gradients[-1].abs().max()),
    )
    assert (step.wave_gradient[waves.rows[6]] == 0).all()
