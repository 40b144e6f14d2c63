"""How well a scene in tiles shows photos where two tiles meet, beside the rest of each photo."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import torch
from torch import Tensor

from splatmill_worker.splat.engine.cpu import CpuEngine
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.evaluate import psnr
from splatmill_worker.splat.gaussians import SH_C0, Gaussians
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train.renderer import evaluation_background, renderer
from splatmill_worker.splat.views import TrainingView
from splatmill_worker.tiles.visibility import reduced

MOST_LIGHT = 0.9
"""Share of a pixel's light that one tile has at most where the pixel counts as a seam."""

TILES_AT_A_TIME = 3
"""Tiles of whose light one rendering has the shares: a colour channel each."""


@dataclass(frozen=True)
class SeamScore:
    """PSNR in dB of all pixels of the held-out photos together, in two parts; None for a part without pixels.

    share: of the pixels that are seams.
    seams, others: PSNR of the scene on the seams and elsewhere.
    coarse_seams, coarse_others: the same of the coarse model, which has no seams. What seams cost is the difference of
        what the tiles gain over it in the two parts.
    """

    share: float
    seams: float | None
    others: float | None
    coarse_seams: float | None
    coarse_others: float | None

    @property
    def cost(self) -> float | None:
        """dB that the tiles gain less on seams than elsewhere; negative where they gain more."""
        if (
            self.seams is None
            or self.coarse_seams is None
            or self.others is None
            or self.coarse_others is None
        ):
            return None
        return (self.others - self.coarse_others) - (self.seams - self.coarse_seams)


class Seams:
    """Where photos show the seams of tiles, by the coarse model.

    coarse: the coarse model.
    members: of each tile, bool [N] over the Gaussians of the coarse model.
    plan: how they are rendered.
    """

    def __init__(self, coarse: Gaussians, members: Sequence[Tensor], plan: Plan) -> None:
        self._coarse, self._members, self._plan = coarse, members, plan

    def measured(
        self, scene: Engine, views: Sequence[TrainingView], on_progress: Callable[[int, int], None]
    ) -> SeamScore:
        """The errors of `scene` and of the coarse model on the two parts of `views`.

        on_progress: called with the number of rendered views, and of all.
        """
        passes = math.ceil(len(self._members) / TILES_AT_A_TIME)
        done = count(1)

        def step() -> None:
            on_progress(next(done), len(views) * (passes + 1))

        background = evaluation_background(self._plan, views)
        renders = [renderer(each, self._plan) for each in (scene, CpuEngine(self._coarse))]
        sums = torch.zeros(2, 2, dtype=torch.float64)  # by model, then seams and others
        counts = torch.zeros(2, dtype=torch.float64)
        for view, seams in zip(views, self._of(views, step), strict=True):
            step()
            target = view.full
            used = torch.ones(target.rgb.shape[:2], dtype=torch.bool) if target.mask is None else target.mask
            parts = [used & seams, used & ~seams]
            counts += torch.tensor([float(part.sum()) for part in parts])
            photo = target.over(background).float() / 255.0
            for row, render in enumerate(renders):
                error = (
                    (render(target, background).detach().cpu().clamp(0.0, 1.0) - photo)
                    .square()
                    .mean(dim=2)
                    .double()
                )
                sums[row] += torch.stack([error[part].sum() for part in parts])
        values = [
            None if counts[part] == 0 else psnr(float(sums[row, part] / counts[part]))
            for row in range(2)
            for part in range(2)
        ]
        return SeamScore(float(counts[0] / counts.sum().clamp_min(1.0)), *values)

    def _of(self, views: Sequence[TrainingView], step: Callable[[], None]) -> Iterator[Tensor]:
        """For each view bool [H, W]: pixels that the tiles fill, and most of whose light is of no one tile.

        They are found on views reduced as for the parts of photos, of TILES_AT_A_TIME, so that many tiles need no more
        memory. step: called for each view of these.
        """
        cameras = [reduced(view.full.camera) for view in views]
        largest = [torch.zeros(camera.height, camera.width) for camera in cameras]
        light = [torch.zeros_like(each) for each in largest]
        for first in range(0, len(self._members), TILES_AT_A_TIME):
            engine = CpuEngine(_with_colors(self._coarse, self._members[first : first + TILES_AT_A_TIME]))
            for index, camera in enumerate(cameras):
                step()
                shares, _, _ = engine.forward(
                    torch.as_tensor(camera.viewmat, dtype=torch.float32),
                    torch.as_tensor(camera.K, dtype=torch.float32),
                    camera.width,
                    camera.height,
                    degree=0,
                    antialias=self._plan.antialias,
                )
                largest[index] = torch.maximum(largest[index], shares.amax(dim=2))
                light[index] += shares.sum(dim=2)
        for view, most, whole in zip(views, largest, light, strict=True):
            seams = (most < MOST_LIGHT * whole) & (whole > 0.5)
            size = view.full.rgb.shape[:2]
            yield torch.nn.functional.interpolate(seams[None, None].float(), size=size)[0, 0] > 0


def _with_colors(coarse: Gaussians, members: Sequence[Tensor]) -> Gaussians:
    """The Gaussians with a colour channel of 1 for the members of each of up to three tiles, and 0 for the others."""
    colors = torch.zeros(coarse.count, 3)
    for channel, of_tile in enumerate(members):
        colors[:, channel] = of_tile.float()
    return Gaussians(
        coarse.means,
        coarse.log_scales,
        coarse.quats,
        coarse.logit_opacities,
        ((colors - 0.5) / SH_C0)[:, None],
    )
