"""How much one training step enqueues, by mode: every kernel and every operation of torch, with the reason for each.

An operation too many costs host and device microseconds each, and nobody would see it in a result. On a device a sort
or a sum is several launches, and a random background that lies on the host is one more copy: those are not counted
here. What the launches compute is not this file's concern.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
import torch

pytest.importorskip(
    "triton", reason="Triton comes with torch's GPU builds; pip install triton to prove the kernels here"
)

from splatmill_worker.kernels.gpu.step import Step
from splatmill_worker.kernels.records import Rates
from tests.support.kernels.cases import scene
from tests.support.kernels.launches import Enqueued, watch

pytestmark = [
    pytest.mark.slow,
    pytest.mark.no_cover,  # tracing makes the interpreter several times slower
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # the interpreter's numpy, in lanes that are masked
    pytest.mark.skipif(
        torch.cuda.is_available(), reason="autotuning launches more; the interpreter counts the same"
    ),
]
WIDTH, HEIGHT = 20, 12
RATES = Rates(0.1, 0.1, 0.1, 0.1, 0.1, 0.1)
CASE = scene("small", 6, width=WIDTH, height=HEIGHT, seed=31)
PHOTO = torch.full((HEIGHT, WIDTH, 3), 90, dtype=torch.uint8)
ALPHA = torch.full((HEIGHT, WIDTH), 200, dtype=torch.uint8)
MASK = torch.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 5 > 0

RENDER = {
    "project_kernel": 1,
    "compact_kernel": 1,  # the visible splats, so that fewer are sorted
    "pairs_kernel": 2,  # counts, then writes: the place of a pair follows from the counts before it
    "composite_kernel": 1,
}
BACK = {
    "composite_backward_kernel": 1,
    "color_backward_kernel": 1,
    "shape_backward_kernel": 1,  # apart from the colour: together they need more registers than there are
    "scores_kernel": 1,
    "drift_kernel": 1,  # what each Gaussian missed, once for all its parameters
    "planes_kernel": 1,
}
LOSS = {
    "across_kernel": 1,  # the window along rows, then
    "value_kernel": 1,  # along columns, with the value and its slopes; and both ways for the gradient
    "down_kernel": 1,
    "gradient_kernel": 1,
    "total_kernel": 1,  # the programs' sums, in an order that does not vary
}
LISTS = {
    "gt": 1,  # which are visible
    "cumsum": 3,  # their ranks; the places of their pairs; the segments of the tiles
    "clamp": 1,  # how many of them there is room for
    "full": 3,  # room for depths and for keys, filled with what sorts last; owners of segments
    "sort": 2,  # by depth, then by tile
    "index": 2,  # the order of the splats, and of the pairs, as their sorts left it
    "searchsorted": 1,  # where each tile begins
    "arange": 1,
    "cat": 1,  # numbers of visible splats and pairs
    "sub": 1, "add": 1, "div": 1, "copy_": 1,  # segments from the lengths of the lists
}  # fmt: skip
ZEROS = {"render": 4, "loss": 1, "gradient": 1, "refused": 1}
"""Arrays that are added to or written in part: splats, counts, ids and first segments; sums; gradient; refusals."""
NUMBERS = {
    "_to_copy": 1,
    "cat": 1,
    "clone": 1,
}  # losses, sizes and refusals as one array, on its way to the host

TRAINED = Counter(LISTS) + Counter(zeros=sum(ZEROS.values())) + Counter(NUMBERS)
MODES: dict[str, dict[str, Any]] = {
    "opaque": {},
    "antialiased": {"antialias": True},
    "masked": {"mask": MASK},
    "transparent": {"alpha": ALPHA},
    "transparent and masked": {"alpha": ALPHA, "mask": MASK},
}


def step() -> Step:
    return Step(*CASE.groups(), where="cpu")


@pytest.fixture
def kernels(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Launches of kernels by name, counted from here on."""
    counts: Counter[str] = Counter()
    watch(monkeypatch, lambda launch: counts.update([launch.kernel]))
    return counts


@pytest.mark.parametrize("mode", MODES)
def test_a_training_step_enqueues_what_is_written_down(mode: str, kernels: Counter[str]) -> None:
    here, options = step(), {"degree": 1, "rates": RATES, "background": CASE.background, **MODES[mode]}
    here.train(CASE.viewmat, CASE.K, PHOTO, step=1, **options)
    kernels.clear()
    with Enqueued() as operations:
        here.train(CASE.viewmat, CASE.K, PHOTO, step=2, **options)
    # A transparent photo is laid over each step's background, so that the statistics of its windows are each step's.
    over = (
        dict.fromkeys(("over_kernel", "row_stats_kernel", "stats_kernel"), 1)
        if "alpha" in MODES[mode]
        else {}
    )
    assert dict(kernels) == {**RENDER, **LOSS, **BACK, **over}
    assert operations.counts == TRAINED
    assert kernels.total() + operations.counts.total() == 45 + len(over)


def test_an_image_enqueues_what_is_written_down(kernels: Counter[str]) -> None:
    here, d_color = step(), torch.ones(HEIGHT, WIDTH, 3)
    here.forward(CASE.viewmat, CASE.K, WIDTH, HEIGHT, degree=1)
    here.backward_update(d_color, rates=RATES, step=1)  # makes Adam's table of bias corrections
    kernels.clear()
    with Enqueued() as operations:
        here.forward(CASE.viewmat, CASE.K, WIDTH, HEIGHT, degree=1)
    assert dict(kernels) == RENDER
    # The sizes on their way to the host, and alpha, which is what the transmittance leaves of 1.
    assert operations.counts == Counter(LISTS) + Counter(zeros=ZEROS["render"], clone=1, rsub=1)
    kernels.clear()
    with Enqueued() as operations:
        here.backward_update(d_color, rates=RATES, step=2)
    assert dict(kernels) == BACK
    # Three zeros in the place of the losses.
    assert operations.counts == Counter(NUMBERS) + Counter(zeros=ZEROS["gradient"] + ZEROS["refused"] + 1)
