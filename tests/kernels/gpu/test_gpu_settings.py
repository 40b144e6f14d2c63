"""Every branch, every autotune setting and every loop of the GPU kernels runs, and gives the definition's gradient.

The shipped constants are made small, so that a tiny image has several segments, several passes of `bin`'s loop, 32-bit
keys and several programs of each kernel. In Triton's interpreter this proves the source, not what a compiler makes of
it; on a GPU the same tests run the compiled kernels. Which setting is fastest is not their concern.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip(
    "triton", reason="Triton comes with torch's GPU builds; pip install triton to prove the kernels here"
)
import triton

from splatmill_worker.kernels import ops, reference
from splatmill_worker.kernels.gpu import (
    adam,
    bin,
    composite,
    composite_backward,
    loss,
    photos,
    project,
    project_backward,
    step,
)
from splatmill_worker.kernels.gpu.blended import SEGMENT
from splatmill_worker.kernels.gpu.launch import tuning
from splatmill_worker.kernels.gpu.step import Step
from splatmill_worker.kernels.records import BETA1, GROUPS, Rates
from splatmill_worker.splat.views import over
from tests.support.kernels.cases import scene
from tests.support.kernels.launches import Launch, watch

pytestmark = [
    pytest.mark.slow,
    pytest.mark.no_cover,  # tracing makes the interpreter several times slower
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # the interpreter's numpy, in lanes that are masked
]
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
EPS = 2.0**-24
WIDTH, HEIGHT = 20, 12
STILL = Rates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
CASE = scene("small", 12, width=WIDTH, height=HEIGHT, seed=31)
G = torch.Generator().manual_seed(3)
PHOTO = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=G, dtype=torch.uint8)
ALPHA = torch.randint(0, 256, (HEIGHT, WIDTH), generator=G, dtype=torch.uint8)
MASK = torch.rand(HEIGHT, WIDTH, generator=G) < 0.8
D_COLOR, D_ALPHA, D_DEPTH = (torch.randn(HEIGHT, WIDTH, *more, generator=G) for more in ((3,), (), ()))
MODES: dict[str, dict[str, Any]] = {
    "bare": {"degree": 0, "background": None},
    "antialiased, masked": {"degree": 1, "antialias": True, "mask": MASK},
    "transparent": {"degree": 2, "alpha": ALPHA},
    "transparent over black, masked": {"degree": 3, "alpha": ALPHA, "mask": MASK, "background": None},
}
IMAGES: dict[str, Sequence[Tensor | None]] = {
    "color": (D_COLOR, None, None),
    "color and alpha": (D_COLOR, D_ALPHA, None),
    "color and depth": (D_COLOR, None, D_DEPTH),
    "color, alpha and depth": (D_COLOR, D_ALPHA, D_DEPTH),
}


def exact(
    dtype: torch.dtype, degree: int, background: Tensor | None, antialias: bool, mask: Tensor | None,
    photo: Tensor | None, weights: Sequence[Tensor | None],
) -> dict[str, Tensor]:  # fmt: skip
    """The definition's gradient [12, ...] of the loss, or of the image's products with `weights`, by group."""
    leaves = [x.requires_grad_() for x in CASE.groups(dtype)]
    means, log_scales, quats, logits, sh = leaves
    viewmat, K = CASE.camera(dtype)
    fields = ops.project(
        means, log_scales, quats, logits, sh, viewmat, K, WIDTH, HEIGHT,
        degree=degree, antialias=antialias, backend="reference",
    )  # fmt: skip
    bins = reference.bin(fields, WIDTH, HEIGHT)
    behind = None if background is None else background.to(dtype)
    image = reference.composite(fields, bins, WIDTH, HEIGHT, background=behind)
    if photo is not None:
        value = reference.loss(image[0], photo, mask=mask)
    else:
        parts = [(x * d.to(dtype)).sum() for x, d in zip(image, weights, strict=True) if d is not None]
        value = torch.stack(parts).sum()
    value.backward()
    return {
        name: torch.zeros_like(x) if x.grad is None else x.grad
        for name, x in zip(GROUPS, leaves, strict=True)
    }


def gradients(here: Step) -> dict[str, Tensor]:
    """The gradients of the one step that was taken, read from Adam's first moment."""
    moment = here.moments()[0].cpu().double() / (1 - BETA1)
    parts = torch.split(moment, list(GROUPS.values()), dim=1)
    return dict(zip(GROUPS, parts, strict=True))


def check(groups: dict[str, Tensor], *definition: Any) -> None:
    """As near to float64 as eight times the definition's own float32, or 64 roundings of the group's largest value."""
    truth, plain = (exact(dtype, *definition) for dtype in (torch.float64, torch.float32))
    for name, value in groups.items():
        expected = truth[name].reshape(value.shape)
        spread = (plain[name].double().reshape(value.shape) - expected).abs().max()
        allowed = 8 * spread + 64 * EPS * expected.abs().max()
        assert float(expected.abs().max()) > 0 or name == "sh", f"{name} has no gradient to compare"
        assert (value - expected).abs().max() <= allowed, name


def trained(mode: str) -> None:
    """One training step in a mode, against the definition."""
    more = {"background": CASE.background, **MODES[mode]}
    here = Step(*CASE.groups(), where=DEVICE)
    here.train(CASE.viewmat, CASE.K, PHOTO, rates=STILL, step=1, **more)
    background, alpha = more["background"], more.get("alpha")
    photo = PHOTO if alpha is None else over(PHOTO, alpha, background)
    options = (more["degree"], background, more.get("antialias", False), more.get("mask"), photo, ())
    check(gradients(here), *options)


def differentiated(which: str) -> None:
    """One forward and backward pass with gradients of some of the images, against the definition."""
    here = Step(*CASE.groups(), where=DEVICE)
    here.forward(CASE.viewmat, CASE.K, WIDTH, HEIGHT, degree=3, background=CASE.background)
    d_color, d_alpha, d_depth = IMAGES[which]
    assert d_color is not None
    here.backward_update(d_color, d_alpha, d_depth, rates=STILL, step=1)
    check(gradients(here), 3, CASE.background, False, None, None, IMAGES[which])


def use(monkeypatch: pytest.MonkeyPatch, kernel: Any, settings: Sequence[triton.Config]) -> None:
    """Have an autotuned kernel choose among these settings alone."""
    monkeypatch.setattr(kernel, "configs", list(settings))
    monkeypatch.setattr(kernel, "cache", {})


PROJECTIONS = (
    project.project_kernel, project_backward.color_backward_kernel, project_backward.shape_backward_kernel,
)  # fmt: skip
LOSSES = (
    loss.row_stats_kernel, loss.stats_kernel, loss.across_kernel, loss.value_kernel, loss.down_kernel,
    loss.gradient_kernel,
)  # fmt: skip


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Constants so small that twelve Gaussians fill several blocks, segments and passes."""
    for module in (composite, composite_backward):
        monkeypatch.setattr(module, "SEGMENT", 4)
    for module, name, value in (
        (bin, "BLOCK", 2), (bin, "LANES", 1), (bin, "SHORT_TILES", 0), (bin, "COMPACT_BLOCK", 4),
        (loss, "TOTAL_BLOCK", 2), (adam, "BLOCK", 4), (step, "SCORES_BLOCK", 4),
        (photos, "BLOCK", 32), (loss, "SMALLEST_LOSS_BLOCK", 64),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, value)
    for kernel in LOSSES:
        use(monkeypatch, kernel, [triton.Config({"BLOCK": 64}, num_warps=2)])
    for kernel in PROJECTIONS:
        use(monkeypatch, kernel, [triton.Config({"BLOCK": 4}, num_warps=1)])
    use(monkeypatch, composite.composite_kernel, [triton.Config({"BATCH": 2}, num_warps=2, num_stages=1)])


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("mode", MODES)
def test_every_mode_of_a_training_step_with_small_constants(
    mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    launches: list[Launch] = []
    watch(monkeypatch, launches.append)
    trained(mode)
    (blended,) = [launch.arguments for launch in launches if launch.kernel == "composite_kernel"]
    lengths = torch.diff(blended["offsets"])
    assert int(lengths.max()) > 8, "no list has three segments, and none a second pass"
    written = [x.arguments for x in launches if x.kernel == "pairs_kernel" and x.arguments["WRITE"]]
    assert written[0]["keys"].dtype == torch.int32


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("which", IMAGES)
def test_every_gradient_that_an_image_may_have_with_small_constants(which: str) -> None:
    differentiated(which)


def settings(kernel: Any, among: Sequence[triton.Config]) -> list[Any]:
    """The settings of a kernel; in the interpreter, where warps do not exist, one of each set of constants."""
    by_name = {str(setting if DEVICE == "cuda" else setting.kwargs): setting for setting in among}
    return [
        pytest.param(kernel, setting, id=f"{kernel.fn.__name__} {name}") for name, setting in by_name.items()
    ]


@pytest.mark.parametrize(
    ("kernel", "setting"),
    [
        *settings(composite.composite_kernel, tuning.COMPOSITE),
        *settings(composite_backward.composite_backward_kernel, tuning.COMPOSITE_BACKWARD),
    ],
)
def test_every_setting_that_the_autotuner_may_choose(
    kernel: Any, setting: triton.Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (composite, composite_backward):
        monkeypatch.setattr(module, "SEGMENT", 8)  # the largest batch
    use(monkeypatch, kernel, [setting])
    differentiated("color, alpha and depth")


def test_no_batch_steps_over_a_checkpoint() -> None:
    for setting in (*tuning.COMPOSITE, *tuning.COMPOSITE_BACKWARD):
        assert SEGMENT % setting.kwargs["BATCH"] == 0


@pytest.mark.skipif(DEVICE == "cuda", reason="on a device, the autotuner measures by itself")
@pytest.mark.parametrize("last", [False, True], ids=["the first is best", "the last is best"])
def test_trials_of_the_autotuner_leave_no_trace(last: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each kernel runs with every setting before its launch proper, as the first step on a device has it."""
    kernels = {
        composite.composite_kernel: tuning.COMPOSITE,
        composite_backward.composite_backward_kernel: tuning.COMPOSITE_BACKWARD,
    }
    tried: dict[Any, int] = defaultdict(int)
    for kernel, among in kernels.items():

        def trial(call: Any, quantiles: Any, kernel: Any = kernel) -> list[float]:
            call()
            tried[kernel] += 1
            return [-float(tried[kernel]) if last else float(tried[kernel])] * 3

        use(monkeypatch, kernel, among)
        monkeypatch.setitem(kernel.__dict__, "do_bench", trial)
    differentiated("color")
    assert {kernel: tried[kernel] for kernel in kernels} == {k: len(among) for k, among in kernels.items()}
    for kernel, among in kernels.items():
        assert kernel.best_config.kwargs == among[-1 if last else 0].kwargs


@pytest.mark.parametrize(
    ("pairs", "power"), [(0, 0), (1, 0), (15, 0), (16, 1), (65535, 3), (65536, 4), (2**31 - 1, 7)]
)
def test_a_magnitude_is_a_power_of_sixteen(pairs: int, power: int) -> None:
    assert tuning.magnitude(pairs) == power


@pytest.mark.skipif(DEVICE == "cuda", reason="on a device, the autotuner measures by itself")
def test_what_was_fastest_on_short_lists_is_not_taken_for_long_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first setting is made to be the fastest at the first magnitude, and the last one at all others."""
    kernels = {
        composite.composite_kernel: tuning.COMPOSITE,
        composite_backward.composite_backward_kernel: tuning.COMPOSITE_BACKWARD,
    }
    tried: dict[Any, int] = defaultdict(int)
    for kernel, among in kernels.items():

        def trial(call: Any, quantiles: Any, kernel: Any = kernel, count: int = len(among)) -> list[float]:
            tried[kernel] += 1
            return [float(tried[kernel] if tried[kernel] <= count else -tried[kernel])] * 3

        use(monkeypatch, kernel, among)
        monkeypatch.setitem(kernel.__dict__, "do_bench", trial)
    chosen = []
    for pairs in (7, 7, 70_000, 7):
        for module in (composite, composite_backward):
            monkeypatch.setattr(module, "magnitude", lambda _, pairs=pairs: tuning.magnitude(pairs))
        differentiated("color")
        chosen.append([kernel.best_config.kwargs for kernel in kernels])
    first, last = ([among[place].kwargs for among in kernels.values()] for place in (0, -1))
    assert chosen == [first, first, last, first]
    assert list(tried.values()) == [2 * len(among) for among in kernels.values()]


BRANCHES: dict[str, dict[str, set[Any]]] = {
    "project_kernel": {"USED": {1, 4, 9, 16}, "PLANAR": {True, False}, "ANTIALIAS": {True, False}},
    "color_backward_kernel": {"USED": {1, 4, 9, 16}, "PLANAR": {True, False}},
    "shape_backward_kernel": {"PLANAR": {True, False}, "ANTIALIAS": {True, False}, "VIEWMAT": {True, False}},
    "pairs_kernel": {"WRITE": {True, False}},
    "composite_kernel": {
        "BACKGROUND": {True, False}, "WITH_DEPTH": {True, False}, "CHECKPOINTS": {True, False}, "BATCH": {2, 4, 8},
    },
    "composite_backward_kernel": {"WITH_ALPHA": {True, False}, "WITH_DEPTH": {True, False}, "BATCH": {1, 2}},
    "over_kernel": {"BACKGROUND": {True, False}},
    "across_kernel": {"MASK": {True, False}},
    "row_stats_kernel": {"MASK": {True, False}},
    "value_kernel": {"MASK": {True, False}, "SLOPES": {True, False}},
    "gradient_kernel": {"MASK": {True, False}},
    "compact_kernel": {}, "total_kernel": {}, "down_kernel": {}, "stats_kernel": {}, "scores_kernel": {},
    "planes_kernel": {}, "drift_kernel": {}, "knn_kernel": {}, "median_depth_kernel": {},
}  # fmt: skip
"""The values of constants that choose a branch, by kernel."""


def test_every_branch_of_every_kernel_is_in_the_list_and_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    ran: dict[str, dict[str, set[Any]]] = defaultdict(lambda: defaultdict(set))

    def note(launch: Launch) -> None:
        for name, value in launch.arguments.items():
            if name.isupper() and (isinstance(value, bool) or name in ("USED", "BATCH")):
                ran[launch.kernel][name].add(value)
        ran[launch.kernel]

    kernels = watch(monkeypatch, note)
    for mode in MODES:
        trained(mode)
    for which in IMAGES:
        differentiated(which)
    for kernel, among in (
        (composite.composite_kernel.kernel, tuning.COMPOSITE),
        (composite_backward.composite_backward_kernel.kernel, tuning.COMPOSITE_BACKWARD),
    ):
        for setting in among:
            with monkeypatch.context() as patched:
                use(patched, kernel, [setting])
                differentiated("color and alpha")
    alone()
    assert set(ran) == set(kernels) == set(BRANCHES)
    assert {k: dict(v) for k, v in ran.items()} == BRANCHES


def alone() -> None:
    """The ops by themselves, in rows, with what only they do: a camera's gradient, a loss's value."""
    photo, mask = PHOTO.to(DEVICE), MASK.to(DEVICE)
    for antialias in (False, True):
        leaves = [x.to(DEVICE).requires_grad_() for x in CASE.groups()]
        viewmat = CASE.viewmat.to(DEVICE).requires_grad_()
        case = replace(CASE, antialias=antialias, degree=0)
        fields = case.project(leaves, viewmat, "gpu")
        image = ops.composite(
            fields, ops.bin(fields, WIDTH, HEIGHT, backend="gpu"), WIDTH, HEIGHT, backend="gpu"
        )
        ops.loss(image[0], photo, mask=mask if antialias else None, backend="gpu").backward()
        with torch.no_grad():
            still = CASE.project(leaves, viewmat, "gpu")
            lists = ops.bin(still, WIDTH, HEIGHT, backend="gpu")
            color, _, _ = ops.composite(still, lists, WIDTH, HEIGHT, backend="gpu")
            ops.median_depth(still, lists, WIDTH, HEIGHT, backend="gpu")
            ops.loss(color, photo, backend="gpu")
    ops.knn(torch.ones(4, 3, device=DEVICE), backend="gpu")
