"""A GPU step asks its device for nothing, in any mode; an image that is judged is whole, at the price of one wait.

In Triton's interpreter this proves that no step calls torch for a value, for a shape that depends on one, or for a copy
that waits, and that what a step measured is fetched while it is late. It does not prove that an operation of torch that
is called asynchronous is: on a GPU, torch's own check of synchronisations runs in the same tests. A kernel's first
launches, which the autotuner times, do wait.
"""

from __future__ import annotations

import gc
import warnings
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip(
    "triton", reason="Triton comes with torch's GPU builds; pip install triton to prove the kernels here"
)

from splatmill_worker.kernels import reference
from splatmill_worker.kernels.gpu import photos as gpu_photos
from splatmill_worker.kernels.gpu.bin import Room
from splatmill_worker.kernels.gpu.step import Step
from splatmill_worker.kernels.records import MOST_PAIRS, Rates, TooManyPairs
from splatmill_worker.splat.views import over
from tests.support.kernels.cases import Case, scene
from tests.support.kernels.launches import LateDevice, Launch, nothing_waits, watch

pytestmark = [
    pytest.mark.slow,
    pytest.mark.no_cover,  # tracing makes the interpreter several times slower
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # the interpreter's numpy, in lanes that are masked
]
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
WIDTH, HEIGHT = 20, 12
RATES = Rates(means=1e-3, log_scales=5e-3, quats=1e-3, logit_opacities=5e-2, sh_dc=2.5e-3, sh_rest=1e-4)
G = torch.Generator().manual_seed(3)
PHOTO = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=G, dtype=torch.uint8)
ALPHA = torch.randint(0, 256, (HEIGHT, WIDTH), generator=G, dtype=torch.uint8)
MASK = torch.rand(HEIGHT, WIDTH, generator=G) < 0.8
MODES: dict[str, dict[str, Any]] = {
    "opaque": {},
    "antialiased": {"antialias": True},
    "masked": {"mask": MASK},
    "transparent": {"alpha": ALPHA},
    "transparent and masked": {"alpha": ALPHA, "mask": MASK},
}


@pytest.fixture
def case() -> Case:
    return scene("small", 8, width=WIDTH, height=HEIGHT, seed=31)


def engine(case: Case) -> Step:
    return Step(*case.groups(), where=DEVICE)


def backgrounds(count: int) -> list[Tensor]:
    """Random ones, as training draws them on the host."""
    g = torch.Generator().manual_seed(2)
    return [torch.rand(3, generator=g) for _ in range(count)]


@pytest.mark.parametrize("mode", MODES)
def test_a_step_over_a_known_view_asks_the_device_for_nothing(
    case: Case, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch(monkeypatch, lambda launch: None)
    late, here = LateDevice(monkeypatch), engine(case)
    first, second, third = backgrounds(3)
    more: dict[str, Any] = {"degree": 1, "rates": RATES, **MODES[mode]}
    here.train(case.viewmat, case.K, PHOTO, step=1, background=first, **more)
    assert late.waits == 2, (
        "a first visit waits for the sizes of its lists, and the first step of all for its numbers"
    )
    with nothing_waits():
        here.train(case.viewmat, case.K, PHOTO, step=2, background=second, **more)
        here.keep_scores = False
        here.train(case.viewmat, case.K, PHOTO, step=3, background=third, **more)
    assert late.waits == 2
    if DEVICE == "cuda":
        torch.cuda.synchronize()


def test_a_host_that_runs_ahead_waits_for_a_step_long_past(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    ahead = 2
    monkeypatch.setattr("splatmill_worker.kernels.gpu.transfers.readback.AHEAD", ahead)
    late, here = LateDevice(monkeypatch), engine(case)
    waits: list[int] = []
    for step in range(1, ahead + 4):
        here.train(case.viewmat, case.K, PHOTO, degree=0, rates=RATES, step=step)
        waits.append(late.waits)
    # Two at the first visit; then the numbers of `ahead` steps may be on their way.
    assert waits == [2] * (ahead + 1) + [3, 4]


@pytest.mark.parametrize(
    "sin",
    [
        pytest.param(lambda x: x.sum().item(), id="item"),
        pytest.param(lambda x: bool(x[0] > 0), id="bool"),
        pytest.param(lambda x: int(x[0]), id="int"),
        pytest.param(lambda x: x.cpu(), id="cpu"),
        pytest.param(lambda x: x.tolist(), id="tolist"),
        pytest.param(lambda x: x[x > 0], id="index by a mask"),
        pytest.param(lambda x: torch.nonzero(x), id="nonzero"),
        pytest.param(lambda x: x.new_zeros(3).index_put_((x > 0,), x[:1]), id="put by a mask"),
        pytest.param(lambda x: torch.tensor([1.0]), id="tensor of numbers"),
        pytest.param(lambda x: x.to("cpu"), id="to the host"),
        pytest.param(lambda x: torch.unique(x), id="unique"),
        pytest.param(lambda x: x.repeat_interleave(torch.ones_like(x).long()), id="repeat_interleave"),
        pytest.param(lambda x: torch.equal(x, x), id="equal"),
    ],
)
def test_the_check_notices_what_waits(sin: Any) -> None:
    with pytest.raises(AssertionError, match="wait"), nothing_waits():
        sin(torch.ones(3))


def test_the_check_ends_though_torch_warns_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device is played. Left in that mode, it would fail all tests that come after in the process."""
    modes: list[Any] = [0]

    def choose(mode: Any) -> None:
        modes.append(mode)
        if len(modes) == 2:
            warnings.warn("Synchronization debug mode is a prototype feature and does not yet", stacklevel=1)

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: modes[-1])
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", choose)
    with nothing_waits():
        assert modes == [0, "error"]
    assert modes == [0, "error", 0]


@pytest.mark.parametrize("room", [Room(1, 1), Room(3, 10**6), Room(10**6, 2), None])
def test_an_image_that_is_judged_is_whole(
    case: Case, room: Room | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever room a view had, nothing is left out of what `forward` gives, and it waits once per attempt."""
    late, here = LateDevice(monkeypatch), engine(case)
    watch(monkeypatch, lambda launch: None)
    fields = case.project(case.groups(torch.float64), case.viewmat.double(), "reference")
    bins = reference.bin(fields, WIDTH, HEIGHT)
    exact = reference.composite(fields, bins, WIDTH, HEIGHT, background=case.background.double())
    if room is not None:
        here._rooms[case.viewmat.data_ptr(), WIDTH, HEIGHT] = room
    with nothing_waits():
        image = here.forward(case.viewmat, case.K, WIDTH, HEIGHT, degree=3, background=case.background)
    for part, truth in zip(image, exact, strict=True):
        # Eight splats at most over a pixel: some roundings of each, of values near 1; a dropped one is off by 1/255.
        assert (part.cpu() - truth).abs().max() < 1e-5 * max(1.0, float(truth.abs().max()))
    assert (here.repeated, late.waits) == ((0, 1) if room is None else (1, 2))
    assert here.overflowed == 0


def test_a_first_visit_of_training_leaves_nothing_out(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatmill_worker.kernels.gpu.step.FIRST_PAIRS", 0)
    monkeypatch.setattr("splatmill_worker.kernels.gpu.step.SPARE", 1)
    here, roomy = engine(case), engine(case)
    roomy._rooms[case.viewmat.data_ptr(), WIDTH, HEIGHT] = Room(100, 1000)
    for step in (here, roomy):
        step.train(case.viewmat, case.K, PHOTO, degree=3, rates=RATES, step=1)
    assert here.repeated == 1
    assert here.overflowed == roomy.overflowed == 0
    for a, b in zip(here.moments(), roomy.moments(), strict=True):
        assert torch.allclose(a, b, rtol=1e-5, atol=0)


def test_more_pairs_than_the_lists_hold_are_refused_by_name(case: Case) -> None:
    here = engine(case)
    here._rooms[case.viewmat.data_ptr(), WIDTH, HEIGHT] = Room(100, MOST_PAIRS + 1)
    with pytest.raises(TooManyPairs, match="cover 2147483648 tiles in this view; its lists hold 2147483647"):
        here.forward(case.viewmat, case.K, WIDTH, HEIGHT, degree=0)


@pytest.mark.parametrize("background", [None, torch.tensor([0.25, 0.5, 0.9])])
def test_a_transparent_photo_is_laid_over_the_background_as_the_cpu_does(
    case: Case, background: Tensor | None
) -> None:
    behind = None if background is None else background.to(DEVICE)
    image = gpu_photos.over(PHOTO.to(DEVICE), ALPHA.to(DEVICE), behind).cpu()
    off = (image.int() - over(PHOTO, ALPHA, background).int()).abs()
    # A compiler may fuse the products into the sums, which moves a tie by one level.
    assert int(off.max()) <= (0 if DEVICE == "cpu" else 1)
    apart, together = engine(case), engine(case)
    more: dict[str, Any] = {"degree": 1, "rates": RATES, "step": 1, "background": background}
    apart.train(case.viewmat, case.K, image, **more)
    together.train(case.viewmat, case.K, PHOTO, alpha=ALPHA, **more)
    for a, b in zip(apart.moments(), together.moments(), strict=True):
        assert torch.allclose(a, b, rtol=1e-4, atol=1e-7)


class Kept:
    """A step that is watched for the launches that compute a photo's statistics."""

    def __init__(self, case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
        self.case, self.launched = case, list[Launch]()
        self.step = engine(case)
        watch(monkeypatch, self.launched.append)

    def computed(self, photo: Tensor, **more: Any) -> int:
        """How often statistics were computed in one step."""
        self.launched.clear()
        self.step.train(
            self.case.viewmat, self.case.K, photo, degree=0, rates=RATES, step=1 + self.step._steps, **more
        )
        return sum(launch.kernel == "row_stats_kernel" for launch in self.launched)


def test_a_photos_statistics_are_computed_once_and_kept_with_it(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept, photo, other = Kept(case, monkeypatch), PHOTO.clone(), MASK.clone()
    assert kept.computed(photo) == 1
    assert kept.computed(photo) == 0
    assert kept.computed(photo, mask=MASK) == 1, "statistics under no mask were used under one"
    assert kept.computed(photo, mask=MASK) == 0
    assert kept.computed(photo, mask=other) == 1, "those of another mask were used"
    del other
    gc.collect()
    assert kept.computed(photo) == 1, "those of a mask that is gone were used without one"
    assert kept.computed(photo, alpha=ALPHA) == 1, "a transparent photo changes with its background"
    assert len(kept.step._photos._kept) == 1
    kept.launched.clear()  # they hold the photo
    del photo
    gc.collect()
    assert len(kept.step._photos._kept) == 0


def test_statistics_take_no_more_than_their_room(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    kept, photos = Kept(case, monkeypatch), [PHOTO.clone() for _ in range(3)]
    kept.step._photos._room = 2 * gpu_photos.STATS_BYTES * WIDTH * HEIGHT
    assert [kept.computed(photo) for photo in photos] == [1, 1, 1]
    assert [kept.computed(photo) for photo in photos] == [0, 0, 1]
    kept.step._photos.forget_stats()
    assert [kept.computed(photo) for photo in photos] == [1, 1, 1]


@pytest.mark.parametrize("mask", [None, MASK], ids=["whole", "masked"])
def test_a_step_with_kept_statistics_is_the_step_without(case: Case, mask: Tensor | None) -> None:
    kept, bare = engine(case), engine(case)
    bare._photos.forget_stats()
    for step in (1, 2):
        results = [
            e.train(case.viewmat, case.K, PHOTO, degree=1, rates=RATES, step=step, mask=mask)
            for e in (kept, bare)
        ]
        if DEVICE == "cpu":  # on a device the numbers may be of an earlier step
            assert results[0].loss == pytest.approx(results[1].loss, abs=1e-6)
    for a, b in zip(kept.moments(), bare.moments(), strict=True):
        assert (a - b).abs().max() <= 1e-4 * b.abs().max()
