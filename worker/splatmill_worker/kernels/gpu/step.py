"""The training step on the GPU: a scene's parameters in planes, and a step that does not wait for the device."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import accumulate

import torch
import triton
import triton.language as tl
from torch import Tensor

from splatmill_worker.kernels.records import BETA2, GROUPS, MOST_PAIRS, PARAMETERS, Rates, StepResult

from . import adam, device
from .bin import Lists, Room, lists
from .blended import Blended
from .composite import blend
from .composite_backward import blend_backward
from .launch.argument import Float, Floats, Int
from .loss import loss_and_gradient
from .photos import Photos
from .project import project_records
from .project_backward import project_backward
from .record import EXTENT_X, EXTENT_Y, GRADIENT_STRIDE, MEAN_X, MEAN_Y, STRIDE
from .transfers.readback import Readback
from .transfers.transfer import ToHost, to_device

ViewKey = tuple[int, int, int]
"""What a view is recognised by: address of its viewmat, width and height in pixels."""

PLANES = {
    name: slice(end - GROUPS[name], end)
    for name, end in zip(GROUPS, accumulate(GROUPS.values()), strict=True)
}
"""The planes of each parameter group among the 59."""

PLAIN_SUM, VISIBLE_COUNT, MAX_EXTENT = range(3)
"""Rows of the densification scores [3, N]."""

SPARE = 4096
"""Splats, and pairs, of room in a view's lists on top of `device.ROOM` times what its last visit used."""

FIRST_PAIRS = 3
"""Pairs per Gaussian for which a scene's first view gets room. Where there are more, its lists are made twice."""

SCORES_BLOCK = 256
"""Gaussians per program of `scores_kernel`."""


@triton.jit
def scores_kernel(
    gradient: Floats, records: Floats, scores: Floats, count: Int, half_width: Float, half_height: Float,
    per_image: Float, BLOCK: tl.constexpr,
):  # fmt: skip
    """Add one view to scores [3, N]: the norm of the mean's gradient in NDC units, the visit, the largest extent."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    source = records + i.to(tl.int64) * STRIDE
    extent_x = tl.load(source + EXTENT_X, mask=here, other=0.0)
    extent_y = tl.load(source + EXTENT_Y, mask=here, other=0.0)
    visible = here & (extent_x > 0.0)
    row = gradient + i.to(tl.int64) * GRADIENT_STRIDE
    x = tl.load(row + MEAN_X, mask=visible, other=0.0) * half_width
    y = tl.load(row + MEAN_Y, mask=visible, other=0.0) * half_height
    place = scores + i
    tl.store(place, tl.load(place, mask=visible) + tl.sqrt_rn(x * x + y * y), mask=visible)
    place += count
    tl.store(place, tl.load(place, mask=visible) + 1.0, mask=visible)
    place += count
    largest = tl.maximum(extent_x, extent_y) * per_image
    tl.store(place, tl.maximum(tl.load(place, mask=visible), largest), mask=visible)


@dataclass
class _View:
    """What the backward pass needs of the last forward pass."""

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

    Its methods are those of `kernels.cpu.step.Step`, without gradients to the camera. Photos, masks and cameras on the
    host are copied to the device once, and the copy is kept as long as the caller keeps the tensor, which nobody may
    write into meanwhile. Adam moves the Gaussians that are visible; the others make up for the steps missed when they
    are visible again, or read.

    A training step waits for the device in two cases: at the first visit of a view, for the sizes of its lists, and
    when the host is `readback.AHEAD` steps in front. Later visits use room for what the visit before needed. `forward`
    waits once, when all is enqueued, to know that nothing was left out of the image; the lists are made again with more
    room where something was.

    keep_scores: whether steps add to the densification scores.
    overflowed: training steps whose lists had more pairs than room; the farthest pairs were left out.
    repeated: views rendered again because the first attempt had too little room.
    refused: gradient values that were not finite and were left out, over all steps heard of.

    The scores are views [N] that add up over steps until `replace`: `plain_sum`, `visible_count` and
    `max_extent`, in the units of `kernels.cpu.step.Step`.

    Raises GpuUnavailable where these kernels cannot run, and GpuMemoryShort when memory runs out, with the scene as it
    was before the call.
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
    ) -> None:
        """Take means [N,3], log_scales [N,3], quats [N,4], logit_opacities [N] and sh [N, up to 16, 3].

        where: the device; None is the current GPU, or the CPU under the interpreter.
        """
        self.keep_scores = True
        if where is None:
            where = "cpu" if device.interpreting() else "cuda"
        self.device = torch.device(where)
        if self.device.type != "cpu" and (reason := device.absence(self.device.index or 0)) is not None:
            raise device.GpuUnavailable(reason)
        if self.device.type == "cuda" and self.device.index is None:
            # With its number, as in the device of its tensors.
            self.device = torch.device("cuda", torch.cuda.current_device())
        self._rooms: dict[ViewKey, Room] = {}
        self._photos = Photos(self.device, device.room_for_stats(self.device))
        self._readback = Readback()
        self._steps, self._beta2 = 0, BETA2
        # Counts `replace`: list sizes that arrive from before the last one say nothing of the room needed now.
        self._generation = 0
        self.overflowed = 0
        self.repeated = 0
        self.refused = 0
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
        return self._scores[PLAIN_SUM]

    @property
    def visible_count(self) -> Tensor:
        return self._scores[VISIBLE_COUNT]

    @property
    def max_extent(self) -> Tensor:
        return self._scores[MAX_EXTENT]

    @property
    def logit_opacities(self) -> Tensor:
        """View [1, N] of the logits of the opacities, without the steps missed, to be written to between steps."""
        return self._params[PLANES["logit_opacities"]]

    def parameters(self) -> dict[str, Tensor]:
        """Return copies [N, ...] of the five groups after all steps, the missed ones included; sh [N, 16, 3]."""
        self._catch_up()
        return self._rows(self._params)

    def moments(self) -> tuple[Tensor, Tensor]:
        """Return Adam's first and second moments, [N, 59] each, after all steps; columns in the order of `GROUPS`."""
        self._catch_up()
        return self._exp_avg.t().contiguous(), self._exp_avg_sq.t().contiguous()

    def replace(
        self, parameters: dict[str, Tensor], exp_avg: Tensor | None, exp_avg_sq: Tensor | None
    ) -> None:
        """Take other parameters, with moments [N, 59] or zeros, and set the scores to 0.

        parameters [N, ...] by group; sh with fewer than 16 coefficients is padded with zeros. Raises ValueError for
        groups that are too wide.
        """
        with self._sparing():
            rows = [parameters[name].detach().reshape(parameters["means"].shape[0], -1) for name in GROUPS]
            if rows[-1].shape[1] < GROUPS["sh"]:
                rows[-1] = torch.nn.functional.pad(rows[-1], (0, GROUPS["sh"] - rows[-1].shape[1]))
            params = torch.cat(rows, 1).to(self.device, torch.float32).t().contiguous()
            count = params.shape[1]
            if params.shape[0] != PARAMETERS:
                raise ValueError(
                    f"parameters: expected {PARAMETERS} values for each Gaussian, got {params.shape[0]}"
                )
            moments = [
                torch.zeros_like(params)
                if moment is None
                else moment.to(self.device, torch.float32).t().contiguous()
                for moment in (exp_avg, exp_avg_sq)
            ]
            scores = torch.zeros(3, count, device=self.device)
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
        """Render color [H,W,3], alpha [H,W] and depth [H,W] = sum of weight times z, on the device.

        viewmat [4,4] world to camera, K [3,3] pixels. `backward_update` differentiates the last call. Raises ValueError
        for 2^31 (tile, Gaussian) pairs or more.
        """
        with self._sparing():
            behind = self._background(background)
            self._view = self._shown(
                viewmat, K, width, height, degree, behind, antialias, near, depth=True, whole=True
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
        """Differentiate the last `forward` and move the visible Gaussians by Adam's step number `step`, from 1.

        d_color [H,W,3], d_alpha [H,W] and d_depth [H,W] are the loss's gradients to what `forward` gave. Raises
        RuntimeError without a `forward` since the last update.
        """
        if self._view is None:
            raise RuntimeError(
                "There is nothing to differentiate; backward_update needs a forward pass before it."
            )
        view, self._view = self._view, None
        with self._sparing():
            gradients = [
                None if d is None else to_device(d, self.device) for d in (d_color, d_alpha, d_depth)
            ]
            assert gradients[0] is not None
            visible = self._differentiate(view, gradients[0], gradients[1], gradients[2])
            refused = torch.zeros(1, dtype=torch.int32, device=self.device)
            self._move(visible, view.degree, rates, step, refused)
        self._listen(view.key, torch.zeros(3, device=self.device), view.lists.used, refused)

    def gradients(
        self, d_color: Tensor, d_alpha: Tensor | None = None, d_depth: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return the gradients of the last `forward` to the parameters, [N, ...] each, and change nothing.

        Arguments and errors are those of `backward_update`.
        """
        if self._view is None:
            raise RuntimeError("There is nothing to differentiate; gradients needs a forward pass before it.")
        view = self._view
        with self._sparing():
            records = blend_backward(
                view.records, view.lists.bins, view.image, view.width, view.height, to_device(d_color, self.device),
                d_alpha=None if d_alpha is None else to_device(d_alpha, self.device),
                d_depth=None if d_depth is None else to_device(d_depth, self.device),
            )  # fmt: skip
            planes = torch.zeros_like(self._params)
            project_backward(
                self._groups(self._params), view.viewmat, view.K, view.width, view.height, view.records, records,
                degree=view.degree, antialias=view.antialias, planar=self.count, into=self._groups(planes),
            )  # fmt: skip
            return self._rows(planes)

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
        alpha: Tensor | None = None,
        mask: Tensor | None = None,
        dssim_weight: float = 0.2,
        antialias: bool = False,
        near: float = 0.01,
    ) -> StepResult:
        """One step on one photo, enqueued as a whole: render, L1 + D-SSIM, gradients, scores, Adam.

        photo uint8 [H,W,3]; alpha uint8 [H,W] of a transparent one, which is laid over the background; mask [H,W],
        nonzero where a pixel is used; step counts from 1. The numbers returned are those of up to `readback.AHEAD`
        steps ago: waiting for the step just enqueued would leave the GPU idle.
        """
        height, width = photo.shape[:2]
        with self._sparing():
            behind = self._background(background)
            view = self._shown(
                viewmat, K, width, height, degree, behind, antialias, near, depth=False, whole=False
            )
            seen_photo = self._photos.picture(photo, alpha, mask, behind)
            losses, d_color = loss_and_gradient(
                view.image.color, seen_photo.pixels, dssim_weight=dssim_weight, mask=seen_photo.mask,
                stats=seen_photo.stats, count=seen_photo.count,
            )  # fmt: skip
            assert d_color is not None
            visible = self._differentiate(view, d_color, None, None)
            refused = torch.zeros(1, dtype=torch.int32, device=self.device)
            self._move(visible, degree, rates, step, refused)
        self._listen(view.key, losses, view.lists.used, refused)
        return self._readback.latest

    def _background(self, background: Tensor | None) -> Tensor | None:
        return None if background is None else to_device(background.float(), self.device)

    def _shown(
        self, viewmat: Tensor, K: Tensor, width: int, height: int, degree: int, background: Tensor | None,
        antialias: bool, near: float,
        *, depth: bool, whole: bool,
    ) -> _View:  # fmt: skip
        """Project and composite one view; with `whole`, and at its first visit, nothing is left out."""
        key = (viewmat.data_ptr(), width, height)
        viewmat, K = (self._photos.here(x).float().contiguous() for x in (viewmat, K))
        records = project_records(
            self._groups(self._params), viewmat, K, width, height, degree=degree, near=near, antialias=antialias,
            planar=self.count,
        )  # fmt: skip
        known = self._rooms.get(key)
        room = known or self._first_room()
        while True:
            made = lists(records, width, height, room)
            sizes = ToHost(made.used) if whole or known is None else None
            image = blend(records, made.bins, width, height, background, depth=depth, checkpoints=True)
            if sizes is None:
                break
            visible, pairs = (int(number) for number in sizes.wait())
            self._rooms[key] = _room(visible, pairs)
            if visible <= room.visible and pairs <= room.pairs:
                break
            # With too few splats the number of pairs is too small as well, so this may come twice.
            room = self._rooms[key]
            self.repeated += 1
            del made, image  # their memory is needed again
        return _View(key, viewmat, K, width, height, degree, antialias, records, made, image)

    def _first_room(self) -> Room:
        """Room for a view that was never visited: as much as any other view has."""
        if not self._rooms:
            return Room(self.count, FIRST_PAIRS * self.count + SPARE)
        return Room(
            max(room.visible for room in self._rooms.values()),
            max(room.pairs for room in self._rooms.values()),
        )

    def _differentiate(
        self,
        view: _View,
        d_color: Tensor,
        d_alpha: Tensor | None,
        d_depth: Tensor | None,
    ) -> Tensor:
        """Fill the gradient planes, add to the scores, and return which Gaussians have a gradient, uint8 [N]."""
        size = (view.width, view.height)
        image = view.image
        gradient = blend_backward(
            view.records, view.lists.bins, image, *size, d_color,
            d_alpha=d_alpha, d_depth=d_depth,
        )  # fmt: skip
        project_backward(
            self._groups(self._params), view.viewmat, view.K, *size, view.records, gradient,
            degree=view.degree, antialias=view.antialias, planar=self.count, into=self._groups(self._gradient),
        )  # fmt: skip
        if self.keep_scores:
            self._score(view, gradient)
        return view.lists.shown.view(torch.uint8)

    def _score(self, view: _View, gradient: Tensor) -> None:
        """Add a view's gradient records [N, 16] to the scores."""
        if self.count:
            scores_kernel[(triton.cdiv(self.count, SCORES_BLOCK),)](
                gradient, view.records, self._scores, self.count, 0.5 * view.width, 0.5 * view.height,
                2.0 / max(view.width, view.height), BLOCK=SCORES_BLOCK,
            )  # fmt: skip

    def _move(self, visible: Tensor, degree: int, rates: Rates, step: int, refused: Tensor) -> None:
        channels = PLANES["sh"].start + 3 * (degree + 1) ** 2
        if self._rates is None:
            # What `replace` was given has missed nothing, whatever the number of this step: a resumed run begins late.
            self._last.fill_(step - 1)
        self._rates = (
            rates.means, rates.log_scales, rates.quats, rates.logit_opacities, rates.sh_dc, rates.sh_rest,
        )  # fmt: skip
        self._steps, self._beta2 = step, rates.beta2
        missed = adam.CatchUp(visible, self._last, step, rates.beta2)
        adam.apply_planes(
            self._params,
            self._gradient,
            self._exp_avg,
            self._exp_avg_sq,
            self._rates,
            channels,
            step,
            rates.beta2,
            refused,
            missed,
        )

    def _catch_up(self) -> None:
        """Bring every Gaussian to where dense Adam would have it, with zero gradients while it was not visible."""
        if self._rates is None or not self.count:
            return
        everyone = torch.ones(self.count, dtype=torch.uint8, device=self.device)
        missed = adam.CatchUp(everyone, self._last, self._steps + 1, self._beta2)
        self._last.fill_(self._steps)
        channels = [*list(GROUPS.values())[:-1], 3, GROUPS["sh"] - 3]
        by_plane = [rate for rate, number in zip(self._rates, channels, strict=True) for _ in range(number)]
        rates = to_device(torch.tensor(by_plane), self.device)
        drift = torch.where(self._exp_avg_sq > 0, self._exp_avg / self._exp_avg_sq.sqrt(), 0.0)
        self._params -= rates[:, None] * missed.travel * drift
        self._exp_avg *= missed.decay1
        self._exp_avg_sq *= missed.decay2

    def _listen(self, key: ViewKey, losses: Tensor, used: Tensor, refused: Tensor) -> None:
        """Send a step's numbers to the host, and set the room of the views whose numbers have arrived."""
        values = torch.cat([losses.double(), used, refused])
        for (generation, shown), numbers in self._readback.post((self._generation, key), values):
            self.refused += numbers.refused
            if generation != self._generation:
                continue
            room = self._rooms[shown]
            if numbers.visible > room.visible or numbers.pairs > room.pairs:
                self.overflowed += 1
            self._rooms[shown] = _room(numbers.visible, numbers.pairs)

    def _rows(self, planes: Tensor) -> dict[str, Tensor]:
        """Copies [N, ...] of the groups among planes [59, N]."""
        shapes = {"logit_opacities": (self.count,), "sh": (self.count, 16, 3)}
        return {
            name: planes[group].t().reshape(shapes.get(name, (self.count, GROUPS[name]))).clone()
            for name, group in PLANES.items()
        }

    def _groups(self, planes: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        means, log_scales, quats, logit_opacities, sh = (planes[group] for group in PLANES.values())
        return means, log_scales, quats, logit_opacities[0], sh

    @contextmanager
    def _sparing(self) -> Iterator[None]:
        """Turn a failed allocation into GpuMemoryShort; code inside changes the scene only after it has allocated."""
        try:
            yield
        except torch.OutOfMemoryError as error:
            self._photos.forget_stats()
            torch.cuda.empty_cache()
            raise device.GpuMemoryShort(self.device, getattr(self, "_params", None)) from error


def _room(visible: int, pairs: int) -> Room:
    """Room for a view of these sizes, and more. That for too many pairs is refused when the lists are made."""
    roomy = int(pairs * device.ROOM) + SPARE
    return Room(int(visible * device.ROOM) + SPARE, max(pairs, min(roomy, MOST_PAIRS)))
