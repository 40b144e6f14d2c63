"""One scene under optimisation on the GPU: parameters in planes, and a training step that never waits for
the device.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from splatmill_worker.kernels.records import Rates, Scores

from . import adam, device
from .bin import Lists, Room, lists
from .blended import Blended
from .composite import blend
from .composite_backward import blend_backward
from .loss import loss_and_gradient
from .project import project_records
from .project_backward import project_backward
from .readback import Readback

ViewKey = tuple[int, int, int]  # address of the camera's matrix, width, height
CHANNELS = 59
PARTS = {"means": (0, 3), "log_scales": (3, 6), "quats": (6, 10), "logit_opacities": (10, 11), "sh": (11, 59)}
SLACK, SPARE = 1.25, 4096
"""Room for a view's lists over what its last visit used: views change little from visit to visit,
parameters move slowly.
"""


class Together(Protocol):
    """Several processes that train one scene; each call changes a tensor in place, to the same bits in all
    of them.
    """

    def average_(self, values: Tensor) -> None: ...
    def add_(self, values: Tensor) -> None: ...
    def largest_(self, values: Tensor) -> None: ...


class StepResult(NamedTuple):
    """Of the latest step whose numbers have arrived, up to `readback.AHEAD` steps ago: waiting for them
    would idle the GPU.
    """

    loss: float  # (1 - w) l1 + w (1 - ssim)
    l1: float
    ssim: float
    visible: int
    pairs: int
    refused: int  # gradient values that were not finite, and were left out of the update


@triton.jit
def scores_kernel(gradient, records, scores, count, half_width, half_height, per_image, BLOCK: tl.constexpr):
    """Add one view to scores [4, N]: plain and absolute gradient of the mean in NDC units, visits, largest extent."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    source = records + i.to(tl.int64) * 12
    extent_x = tl.load(source + 10, mask=here, other=0.0)
    extent_y = tl.load(source + 11, mask=here, other=0.0)
    seen = here & (extent_x > 0.0)
    row = gradient + i.to(tl.int64) * 16
    x = tl.load(row, mask=seen, other=0.0) * half_width
    y = tl.load(row + 1, mask=seen, other=0.0) * half_height
    ax = tl.load(row + 10, mask=seen, other=0.0) * half_width
    ay = tl.load(row + 11, mask=seen, other=0.0) * half_height
    place = scores + i
    tl.store(place, tl.load(place, mask=seen) + tl.sqrt_rn(x * x + y * y), mask=seen)
    place += count
    tl.store(place, tl.load(place, mask=seen) + tl.sqrt_rn(ax * ax + ay * ay), mask=seen)
    place += count
    tl.store(place, tl.load(place, mask=seen) + 1.0, mask=seen)
    place += count
    largest = tl.maximum(extent_x, extent_y) * per_image
    tl.store(place, tl.maximum(tl.load(place, mask=seen), largest), mask=seen)


@dataclass
class _View:
    """The last forward pass: what its backward pass needs."""

    key: ViewKey
    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    degree: int
    antialias: bool
    records: Tensor
    lists: Lists
    image: Blended


class Step:
    """Parameters, Adam moments and densification scores of one scene, and the training step over them.

    The interface of `kernels.cpu.step.Step`. Tensors that come from the host (photos, cameras) are copied
    once and kept as long as the caller keeps them; the first visit of a view reads its list sizes back, later
    ones use room from the visit before. Adam moves the Gaussians that a view shows; the others are brought up
    to date when they are seen again, or read.

    together: the processes whose views a step is averaged over; see `splat.engine.parallel`. Raises GpuUnavailable
    where these kernels cannot run, and GpuMemoryShort when memory runs out, with the scene as it was before
    the call.
    """

    def __init__(
        self,
        means: Tensor,
        log_scales: Tensor,
        quats: Tensor,
        logit_opacities: Tensor,
        sh: Tensor,
        *,
        where: torch.device | str | None = None,
        together: Together | None = None,
    ) -> None:
        self.keep_scores: Scores | None = "absolute"
        if where is None:
            where = "cpu" if device.interpreting() else "cuda"
        self.device = torch.device(where)
        if self.device.type != "cpu" and (reason := device.absence(self.device.index or 0)) is not None:
            raise device.GpuUnavailable(reason)
        if self.device.type == "cuda" and self.device.index is None:
            self.device = torch.device(
                "cuda", torch.cuda.current_device()
            )  # as the tensors' own device reads
        self._together = together
        self._rooms: dict[ViewKey, Room] = {}
        self._resident: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
        self._readback = Readback(steady=together is not None)
        self._steps = 0
        self._generation = (
            0  # of the parameters; what arrives late from before a `replace` says nothing of room
        )
        self.overflowed = 0
        """Steps whose lists did not fit into their room: their farthest pairs were left out."""
        self.refused = 0
        """Gradient values that were not finite and were left out, over all steps."""
        self.replace(
            {
                "means": means,
                "log_scales": log_scales,
                "quats": quats,
                "logit_opacities": logit_opacities,
                "sh": sh,
            },
            None,
            None,
        )

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return int(self._params.shape[1])

    @property
    def plain_sum(self) -> Tensor:
        return self._scores[0]

    @property
    def abs_sum(self) -> Tensor:
        return self._scores[1]

    @property
    def visible_count(self) -> Tensor:
        return self._scores[2]

    @property
    def max_extent(self) -> Tensor:
        return self._scores[3]

    def clear_scores(self) -> None:
        """Start the scores anew."""
        self._scores.zero_()

    def parameters(self) -> dict[str, Tensor]:
        """Copies [N, ...] of the five groups, brought up to date; sh [N, 16, 3]."""
        self._catch_up()
        shapes = {"logit_opacities": (self.count,), "sh": (self.count, 16, 3)}
        return {
            name: self._params[a:b].t().reshape(shapes.get(name, (self.count, b - a))).clone()
            for name, (a, b) in PARTS.items()
        }

    def moments(self) -> tuple[Tensor, Tensor]:
        """Adam's first and second moments [N, 59] each, in the order of `parameters`, brought up to date."""
        self._catch_up()
        return self._exp_avg.t().contiguous(), self._exp_avg_sq.t().contiguous()

    def replace(
        self, parameters: dict[str, Tensor], exp_avg: Tensor | None, exp_avg_sq: Tensor | None
    ) -> None:
        """Take over other parameters, and moments [N, 59] (None: zero); scores start again at zero."""
        with self._sparing():
            rows = [parameters[name].detach().reshape(parameters["means"].shape[0], -1) for name in PARTS]
            if rows[-1].shape[1] < 48:
                rows[-1] = torch.nn.functional.pad(rows[-1], (0, 48 - rows[-1].shape[1]))
            params = torch.cat(rows, 1).to(self.device, torch.float32).t().contiguous()
            count = params.shape[1]
            if params.shape[0] != CHANNELS:
                raise ValueError(
                    f"parameters: {params.shape[0]} values per Gaussian where {CHANNELS} are needed"
                )
            moments = [
                torch.zeros_like(params)
                if given is None
                else given.to(self.device, torch.float32).t().contiguous()
                for given in (exp_avg, exp_avg_sq)
            ]
            scores = torch.zeros(4, count, device=self.device)
            gradient = torch.empty_like(params)
            last = torch.full((count,), self._steps, dtype=torch.int32, device=self.device)
        grown = count / max(1, self.count) if hasattr(self, "_params") else 1.0
        self._rooms = {
            key: Room(int(room.visible * grown), int(room.pairs * grown)) for key, room in self._rooms.items()
        }
        self._generation += 1
        self._params, (self._exp_avg, self._exp_avg_sq) = params, moments
        self._scores, self._gradient, self._last = scores, gradient, last
        self._view: _View | None = None
        self._rates: tuple[float, ...] | None = None

    def forward(
        self,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        *,
        degree: int,
        background: Tensor | None = None,
        antialias: bool = False,
        near: float = 0.01,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Colour [H, W, 3], alpha [H, W] and depth [H, W] on the device; `backward_update` takes it from
        here.
        """
        with self._sparing():
            self._view = self._shown(
                viewmat, K, width, height, degree, background, antialias, near, depth=True
            )
        image = self._view.image
        assert image.depth is not None
        return image.color, 1.0 - image.transmittance, image.depth

    def backward_update(
        self,
        d_color: Tensor,
        d_alpha: Tensor | None = None,
        d_depth: Tensor | None = None,
        *,
        rates: Rates,
        step: int,
    ) -> None:
        """Gradient of the last `forward` and one Adam step (number `step`, from 1)."""
        if self._view is None:
            raise RuntimeError("backward_update needs a forward pass before it.")
        view, self._view = self._view, None
        with self._sparing():
            given = [None if d is None else d.to(self.device) for d in (d_color, d_alpha, d_depth)]
            assert given[0] is not None
            seen = self._differentiate(view, given[0], given[1], given[2])
            refused = torch.zeros(1, dtype=torch.int32, device=self.device)
            self._move(seen, view.degree, rates, step, refused)
        self._listen(view.key, torch.zeros(3, device=self.device), view.lists.used, refused)

    def train(
        self,
        viewmat: Tensor,
        K: Tensor,
        photo: Tensor,
        *,
        degree: int,
        rates: Rates,
        step: int,
        background: Tensor | None = None,
        mask: Tensor | None = None,
        dssim_weight: float = 0.2,
        antialias: bool = False,
        near: float = 0.01,
    ) -> StepResult:
        """Forward, loss against photo uint8 [H, W, 3], backward and Adam, enqueued as a whole."""
        height, width = photo.shape[:2]
        with self._sparing():
            view = self._shown(viewmat, K, width, height, degree, background, antialias, near, depth=False)
            seen_photo = self._here(photo)
            used_pixels = None if mask is None else self._here(mask)
            color = view.image.color
            value, l1, ssim, d_color = loss_and_gradient(
                color, seen_photo, dssim_weight=dssim_weight, mask=used_pixels, stats=None
            )
            assert d_color is not None
            seen = self._differentiate(view, d_color, None, None)
            refused = torch.zeros(1, dtype=torch.int32, device=self.device)
            self._move(seen, degree, rates, step, refused)
        losses = torch.stack([value, l1, ssim])
        if self._together is not None:
            self._together.average_(losses)
        self._listen(view.key, losses, view.lists.used, refused)
        return StepResult(*self._readback.latest[1:])

    def _shown(
        self, viewmat: Tensor, K: Tensor, width: int, height: int, degree: int, background: Tensor | None,
        antialias: bool, near: float,
        *, depth: bool,
    ) -> _View:  # fmt: skip
        key = (viewmat.data_ptr(), width, height)
        viewmat, K = self._here(viewmat).float().contiguous(), self._here(K).float().contiguous()
        background = None if background is None else self._sent(background.float())
        records = project_records(
            self._groups(self._params), viewmat, K, width, height, degree=degree, near=near, antialias=antialias,
            planar=self.count,
        )  # fmt: skip
        known = self._rooms.get(key)
        made = lists(records, width, height, known)
        if known is None:
            visible, pairs = made.used.tolist()
            self._rooms[key] = _room(visible, pairs)
        image = blend(records, made.bins, width, height, background, depth=depth, checkpoints=True)
        return _View(key, viewmat, K, width, height, degree, antialias, records, made, image)

    def _differentiate(
        self,
        view: _View,
        d_color: Tensor,
        d_alpha: Tensor | None,
        d_depth: Tensor | None,
    ) -> Tensor:
        """Fill the gradient planes and add to the scores; which Gaussians have a gradient, uint8 [N]."""
        size = (view.width, view.height)
        image = view.image
        gradient = blend_backward(
            view.records, view.lists.bins, image, *size, d_color,
            d_alpha=d_alpha, d_depth=d_depth, scores=self.keep_scores is not None,
        )  # fmt: skip
        project_backward(
            self._groups(self._params), view.viewmat, view.K, *size, view.records, gradient,
            degree=view.degree, antialias=view.antialias, planar=self.count, into=self._groups(self._gradient),
        )  # fmt: skip
        if self.keep_scores is not None:
            self._score(view, gradient)
        return (view.records[:, 10] > 0).to(torch.uint8)

    def _score(self, view: _View, gradient: Tensor) -> None:
        """Add a view's gradient records [N, 16] to the scores, of all processes where there are several."""
        scores = self._scores if self._together is None else torch.zeros_like(self._scores)
        if self.count:
            scores_kernel[(triton.cdiv(self.count, 256),)](
                gradient, view.records, scores, self.count, 0.5 * view.width, 0.5 * view.height,
                2.0 / max(view.width, view.height), BLOCK=256,
            )  # fmt: skip
        if self._together is not None:
            extent = scores[3].clone()
            self._together.largest_(extent)
            scores[3] = 0.0
            self._together.add_(scores)
            self._scores += scores
            torch.maximum(self._scores[3], extent, out=self._scores[3])

    def _move(self, seen: Tensor, degree: int, rates: Rates, step: int, refused: Tensor) -> None:
        channels = 11 + 3 * (degree + 1) ** 2
        if self._together is not None:
            # A Gaussian that any process saw moves in all of them.
            self._together.average_(self._gradient[:channels])
            self._together.largest_(seen)
        self._rates = (
            rates.means, rates.log_scales, rates.quats, rates.logit_opacities, rates.sh_dc, rates.sh_rest,
        )  # fmt: skip
        self._steps = step
        missed = adam.CatchUp(seen, self._last, step)
        adam.apply_planes(
            self._params,
            self._gradient,
            self._exp_avg,
            self._exp_avg_sq,
            self._rates,
            channels,
            step,
            refused,
            missed,
        )

    def _catch_up(self) -> None:
        """What dense Adam with zero gradients would have left of those that recent views did not show."""
        if self._rates is None or not self.count:
            return
        everyone = torch.ones(self.count, dtype=torch.uint8, device=self.device)
        missed = adam.CatchUp(everyone, self._last, self._steps + 1)
        self._last.fill_(self._steps)
        rates = torch.tensor(self._rates, device=self.device).repeat_interleave(
            torch.tensor([3, 3, 4, 1, 3, 45], device=self.device)
        )
        drift = torch.where(self._exp_avg_sq > 0, self._exp_avg / self._exp_avg_sq.sqrt(), 0.0)
        self._params -= rates[:, None] * missed.travel * drift
        self._exp_avg *= missed.decay1
        self._exp_avg_sq *= missed.decay2

    def _listen(self, key: ViewKey, losses: Tensor, used: Tensor, refused: Tensor) -> None:
        """Send a step's numbers to the host, and give views room by what has arrived."""
        values = torch.cat([losses.double(), used.double(), refused.double()])
        for numbers in self._readback.post((self._generation, key), values):
            self.refused += numbers.refused
            generation, key = numbers.key
            if generation != self._generation:
                continue
            room = self._rooms[key]
            if numbers.visible > room.visible or numbers.pairs > room.pairs:
                self.overflowed += 1
            self._rooms[key] = _room(numbers.visible, numbers.pairs)

    def _here(self, tensor: Tensor) -> Tensor:
        """The tensor on this device; a copy is made once and kept while the caller keeps the original."""
        if tensor.device == self.device:
            return tensor.contiguous()
        held = self._resident.get(tensor)
        if held is None:
            held = self._sent(tensor)
            self._resident[tensor] = held
        assert isinstance(held, Tensor)
        return held

    def _sent(self, tensor: Tensor) -> Tensor:
        """A copy on this device. From pinned memory, because a copy from any other waits for all that is
        enqueued.
        """
        if tensor.device.type == "cpu" and self.device.type == "cuda":
            return tensor.contiguous().pin_memory().to(self.device, non_blocking=True)
        return tensor.to(self.device).contiguous()

    def _groups(self, planes: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        a, b, c, d, e = (planes[first:last] for first, last in PARTS.values())
        return a, b, c, d[0], e

    @contextmanager
    def _sparing(self) -> Iterator[None]:
        """Turn the allocator's failure into one that says what to do; nothing is changed before all is
        allocated.
        """
        try:
            yield
        except torch.OutOfMemoryError as error:
            torch.cuda.empty_cache()
            raise device.GpuMemoryShort(self.device, getattr(self, "_params", None)) from error


def _room(visible: int, pairs: int) -> Room:
    return Room(int(visible * SLACK) + SPARE, int(pairs * SLACK) + SPARE)
