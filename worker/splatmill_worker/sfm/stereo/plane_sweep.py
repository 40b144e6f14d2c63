"""Points of one photo by a plane sweep: small patches compared with neighbouring photos at many depths.

After Collins, "A space-sweep approach to true multi-image matching", CVPR 1996. In each cell without a known point, the
patch around the pixel with the strongest gradient is compared with the neighbours at depths that move it by about one
pixel. It becomes a point where two neighbours agree on one unambiguous depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.images.load import Photo
from splatmill_worker.kernels import ops
from splatmill_worker.scene import Camera, Projection

Float = npt.NDArray[np.float64]

CELL = 8
"""Pixels of a cell's side; at most one point is searched for in each cell."""

RADIUS = 3
"""Pixels from a patch's centre to its border: a patch has 7 x 7 pixels."""

MIN_AGREEING = 2
"""Neighbours that must show the patch at the same depth."""

MIN_CONTRAST = 5.0 / 255.0
"""Standard deviation of a patch's grey values (0 to 1) below which it is skipped: noise would be matched."""

STEP = 0.8
"""Pixels between the patch's positions at two consecutive depths, in the neighbour where it moves most."""

MAX_DEPTHS = 160
"""Depths per patch, at most; with more needed, they are farther apart than STEP."""

MIN_SCORE = 0.85
"""Normalised cross-correlation, averaged over the best neighbours, from which a depth is accepted."""

MIN_MARGIN = 0.08
"""Margin by which the best depth's correlation must exceed that of every depth that is not adjacent to it."""

ADJACENT = 2
"""Steps within which two depths count as adjacent."""

MAX_ERROR = 1.0
"""Pixels: largest mean distance between the best position in each agreeing neighbour and the common one."""


class SweepResult(NamedTuple):
    """Points found in one photo.

    points: positions in the world [n,3].
    colors: RGB [n,3].
    errors: mean disagreement of the neighbours, in pixels of the compared photos [n].
    agreeing: which neighbours show each point too [n,neighbours].
    tried: number of patches that were compared.
    """

    points: Float
    colors: npt.NDArray[np.uint8]
    errors: Float
    agreeing: npt.NDArray[np.bool_]
    tried: int


@dataclass(frozen=True)
class GreyView:
    """A photo prepared for the sweep.

    camera: at the photo's size.
    grey: luma [H,W], 0 to 1.
    photo: its colours, mask and transparency.
    """

    camera: Camera
    grey: torch.Tensor
    photo: Photo

    @staticmethod
    def of(photo: Photo) -> GreyView:
        """The photo with its luma by ITU-R BT.601."""
        grey = torch.from_numpy(photo.rgb).float() @ torch.tensor([0.299, 0.587, 0.114]) / 255.0
        return GreyView(photo.camera, grey, photo)


def sweep(
    view: GreyView, neighbours: Sequence[GreyView], known: Projection, near: float, far: float
) -> SweepResult:
    """New points of the photo `view`, between the known ones.

    neighbours: at least MIN_AGREEING other photos.
    known: where known points fall on the photo; cells that show one are skipped.
    near, far: range of depths, in world units; the depths compared are evenly spaced in inverse depth.
    """
    camera = view.camera
    columns, rows = _candidates(view, known.columns[known.inside], known.rows[known.inside])
    offsets = torch.arange(-RADIUS, RADIUS + 1, dtype=torch.float32)
    dy, dx = (grid.flatten() for grid in torch.meshgrid(offsets, offsets, indexing="ij"))
    px, py = columns[:, None] + 0.5 + dx, rows[:, None] + 0.5 + dy
    rays = torch.stack([*camera.normalized(px, py), torch.ones_like(px)], dim=-1)
    patch = view.grey[(rows[:, None] + dy).long(), (columns[:, None] + dx).long()]
    patch = patch - patch.mean(1, keepdim=True)
    textured = patch.square().mean(1).sqrt() >= MIN_CONTRAST
    rays, patch = rays[textured], patch[textured]
    tried = len(patch)
    if not tried:
        nowhere = np.zeros((0, len(neighbours)), bool)
        return SweepResult(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), nowhere, 0)
    patch = patch / patch.norm(dim=1, keepdim=True)
    poses = [other.camera.viewmat @ np.linalg.inv(camera.viewmat) for other in neighbours]
    inverse, pixels = _inverse_depths([other.camera for other in neighbours], poses, near, far)
    scores = torch.stack(
        [_scores(rays, patch, inverse, pose, other) for other, pose in zip(neighbours, poses, strict=True)]
    )
    best, position, agreeing, error = _peaks(scores, pixels)
    good = torch.isfinite(best).nonzero()[:, 0]
    depth = 1.0 / torch.from_numpy(
        np.interp(position[good].numpy(), np.arange(len(inverse)), inverse.numpy())
    )
    local = rays[good, (2 * RADIUS + 1) ** 2 // 2].double() * depth[:, None]
    column, row = columns[textured][good].long().numpy(), rows[textured][good].long().numpy()
    return SweepResult(
        camera.to_world(local.numpy()),
        view.photo.rgb[row, column],
        error[good].double().numpy(),
        agreeing[:, good].T.numpy(),
        tried,
    )


def _candidates(view: GreyView, x: Float, y: Float) -> tuple[torch.Tensor, torch.Tensor]:
    """Column and row of the pixel with the strongest gradient in each cell without a known point.

    x, y: positions of the known points, in pixels. Masked and transparent pixels are no candidates.
    """
    height, width = view.grey.shape
    grey = view.grey
    strength = torch.zeros_like(grey)
    strength[1:-1, 1:-1] = (grey[1:-1, 2:] - grey[1:-1, :-2]).square() + (
        grey[2:, 1:-1] - grey[:-2, 1:-1]
    ).square()
    strength[:RADIUS] = strength[-RADIUS:] = strength[:, :RADIUS] = strength[:, -RADIUS:] = 0.0
    if view.photo.mask is not None:
        strength[~torch.from_numpy(view.photo.mask)] = 0.0
    if view.photo.alpha is not None:
        strength[torch.from_numpy(view.photo.alpha < 255)] = 0.0
    down, across = height // CELL, width // CELL
    cells = strength[: down * CELL, : across * CELL].reshape(down, CELL, across, CELL).transpose(1, 2)
    value, at = cells.reshape(down, across, CELL * CELL).max(dim=2)
    taken = np.zeros((down + 1, across + 1), bool)
    taken[(y // CELL).astype(int), (x // CELL).astype(int)] = True
    free = (value > 0) & ~torch.from_numpy(taken[:down, :across])
    cell_row, cell_column = free.nonzero(as_tuple=True)
    within = at[free]
    return (cell_column * CELL + within % CELL).float(), (cell_row * CELL + within // CELL).float()


def _inverse_depths(
    neighbours: Sequence[Camera], poses: Sequence[Float], near: float, far: float
) -> tuple[torch.Tensor, list[float]]:
    """The inverse depths to compare, and the pixels per step in each neighbour.

    poses: rigid motions [4,4] from the swept camera to each neighbour. A step is STEP pixels long in the neighbour in
    which a point on the optical axis moves most between `near` and `far`.
    """
    ends = np.array([[0.0, 0.0, near], [0.0, 0.0, far]])
    spans = []
    for other, pose in zip(neighbours, poses, strict=True):
        local = ends @ pose[:3, :3].T + pose[:3, 3]
        # Unlike Camera.project: an end behind the neighbour is clamped, so that it has a large but finite span.
        z = np.maximum(local[:, 2], 1e-3 * near)
        x, y = local[:, 0] / z * other.fx, local[:, 1] / z * other.fy
        spans.append(float(np.hypot(x[1] - x[0], y[1] - y[0])))
    count = int(np.clip(np.ceil(max(spans) / STEP), 4 * ADJACENT, MAX_DEPTHS))
    return torch.linspace(1.0 / far, 1.0 / near, count), [span / (count - 1) for span in spans]


def _scores(
    rays: torch.Tensor, patch: torch.Tensor, inverse: torch.Tensor, pose: Float, other: GreyView
) -> torch.Tensor:
    """Normalised cross-correlation [n,depths] of patches with a neighbour at each depth.

    -1 where the patch's centre is behind the neighbour or too near to its border.
    """
    K = other.camera.K
    return ops.correlate(
        other.grey,
        rays,
        patch,
        inverse,
        torch.from_numpy(K @ pose[:3, :3]).float(),
        torch.from_numpy(K @ pose[:3, 3]).float(),
        margin=float(RADIUS),
        least_variance=(0.5 * MIN_CONTRAST) ** 2,
    )


def _peaks(
    scores: torch.Tensor, pixels: Sequence[float]
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """The best depth of each patch, from scores [neighbours,n,depths] and the pixels per step of each neighbour.

    Returns the best score [n], NaN where no depth is accepted; its position in steps, refined between them [n]; which
    neighbours agree [neighbours,n]; and their mean distance from that position in pixels [n].
    """
    common = scores.topk(min(MIN_AGREEING, len(scores)), dim=0).values.mean(0)
    best, at = common.max(dim=1)
    depths = common.shape[1]
    steps = torch.arange(depths)
    adjacent = (steps[None] - at[:, None]).abs() <= ADJACENT
    rival = common.masked_fill(adjacent, -1.0).max(dim=1).values
    inner = (at > 0) & (at < depths - 1)
    left = common.gather(1, (at - 1).clamp_min(0)[:, None])[:, 0]
    right = common.gather(1, (at + 1).clamp_max(depths - 1)[:, None])[:, 0]
    # The vertex of the parabola through the three scores.
    shift = 0.5 * (left - right) / (left - 2.0 * best + right).clamp_max(-1e-6)
    position = at + shift.clamp(-0.5, 0.5)
    own_score, own = scores.masked_fill(~adjacent[None], -1.0).max(dim=2)
    agreeing = own_score >= MIN_SCORE
    away = (own - at[None]).abs() * torch.tensor(pixels)[:, None]
    count = agreeing.sum(0)
    error = (away * agreeing).sum(0) / count.clamp_min(1)
    good = (
        inner
        & (best >= MIN_SCORE)
        & (best - rival >= MIN_MARGIN)
        & (count >= MIN_AGREEING)
        & (error <= MAX_ERROR)
    )
    return torch.where(good, best, torch.nan), position, agreeing, error
