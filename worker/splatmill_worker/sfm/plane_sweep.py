"""Points of one photo by sweeping small patches along their rays through its neighbours.

After Collins, "A space-sweep approach to true multi-image matching", CVPR 1996: the most textured pixel of each cell
without a known point is compared with three neighbouring photos at depths a pixel apart, and becomes a point where
two of them agree on one clear place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker.images.load import Photo
from splatmill_worker.scene import Camera

Float = npt.NDArray[np.float64]

CELL = 8  # pixels: at most one point is looked for in each
RADIUS = 3  # pixels around a patch's centre
AGREE = 2  # neighbours that have to show the patch
MIN_CONTRAST = 5.0 / 255.0  # standard deviation of a patch: below, noise is matched
STEP = 0.8  # pixels between two depths, in the neighbour that moves the most
MAX_DEPTHS = 160  # of all depths: photos that would need more are compared a little more coarsely
MIN_SCORE = 0.85  # normalised cross-correlation, mean over the best neighbours
CLEAR = 0.08  # by which the best place beats any other that is not beside it
BESIDE = 2  # depths
MAX_ERROR = 1.0  # pixels between the places that single neighbours prefer and the common one


class Found(NamedTuple):
    """What a photo gave: points [n,3], colours [n,3], errors in its pixels [n], which views saw each [n,views], and
    how many patches were tried."""

    points: Float
    colors: npt.NDArray[np.uint8]
    errors: Float
    seen: npt.NDArray[np.bool_]
    tried: int


@dataclass(frozen=True)
class Shot:
    """A photo on which patches are compared: its camera, grey [H,W] in 0..1, and its pixels."""

    camera: Camera
    grey: torch.Tensor
    photo: Photo

    @staticmethod
    def of(photo: Photo) -> Shot:
        """The photo in grey (luma of BT.601)."""
        grey = torch.from_numpy(photo.rgb).float() @ torch.tensor([0.299, 0.587, 0.114]) / 255.0
        return Shot(photo.camera, grey, photo)


def sweep(
    index: int,
    shot: Shot,
    others: Sequence[tuple[int, Shot]],
    points: Float,
    views: int,
    near: float,
    far: float,
) -> Found:
    """New points of photo `index` (of `views`), at depths from `near` to `far`, beside the known `points` [n,3].

    `others` are at least AGREE neighbours with their indices. Depths are evenly spaced in their inverse.
    """
    known = shot.camera.project(points)
    columns, rows = _candidates(shot, known.columns[known.inside], known.rows[known.inside])
    offsets = torch.arange(-RADIUS, RADIUS + 1, dtype=torch.float32)
    dy, dx = (grid.flatten() for grid in torch.meshgrid(offsets, offsets, indexing="ij"))
    px, py = columns[:, None] + 0.5 + dx, rows[:, None] + 0.5 + dy
    camera = shot.camera
    rays = torch.stack([*camera.normalized(px, py), torch.ones_like(px)], dim=-1)
    patch = shot.grey[(rows[:, None] + dy).long(), (columns[:, None] + dx).long()]
    patch = patch - patch.mean(1, keepdim=True)
    textured = patch.square().mean(1).sqrt() >= MIN_CONTRAST
    rays, patch = rays[textured], patch[textured]
    tried = len(patch)
    if not tried:
        return Found(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), np.zeros((0, views), bool), 0)
    patch = patch / patch.norm(dim=1, keepdim=True)
    poses = [other.camera.viewmat @ np.linalg.inv(camera.viewmat) for _, other in others]
    inverse, pixels = _inverse_depths(camera, [o.camera for _, o in others], poses, near, far)
    scores = torch.stack(
        [_scores(rays, patch, inverse, pose, o) for (_, o), pose in zip(others, poses, strict=True)]
    )
    best, place, agreeing, error = _peaks(scores, pixels)
    good = torch.isfinite(best).nonzero()[:, 0]
    depth = 1.0 / torch.from_numpy(np.interp(place[good].numpy(), np.arange(len(inverse)), inverse.numpy()))
    local = rays[good, (2 * RADIUS + 1) ** 2 // 2].double() * depth[:, None]
    seen = np.zeros((len(good), views), bool)
    seen[:, index] = True
    for (k, _), agrees in zip(others, agreeing[:, good].numpy(), strict=True):
        seen[:, k] = agrees
    column, row = columns[textured][good].long().numpy(), rows[textured][good].long().numpy()
    return Found(
        camera.to_world(local.numpy()), shot.photo.rgb[row, column], error[good].double().numpy(), seen, tried
    )


def _candidates(shot: Shot, x: Float, y: Float) -> tuple[torch.Tensor, torch.Tensor]:
    """Column and row of the pixel with the strongest gradient in each cell that holds no known point."""
    height, width = shot.grey.shape
    grey = shot.grey
    strength = torch.zeros_like(grey)
    strength[1:-1, 1:-1] = (grey[1:-1, 2:] - grey[1:-1, :-2]).square() + (
        grey[2:, 1:-1] - grey[:-2, 1:-1]
    ).square()
    strength[:RADIUS] = strength[-RADIUS:] = strength[:, :RADIUS] = strength[:, -RADIUS:] = 0.0
    if shot.photo.mask is not None:
        strength[~torch.from_numpy(shot.photo.mask)] = 0.0
    if shot.photo.alpha is not None:
        strength[torch.from_numpy(shot.photo.alpha < 255)] = 0.0
    down, across = height // CELL, width // CELL
    cells = strength[: down * CELL, : across * CELL].reshape(down, CELL, across, CELL).transpose(1, 2)
    value, at = cells.reshape(down, across, CELL * CELL).max(dim=2)
    taken = np.zeros((down + 1, across + 1), bool)
    taken[(y // CELL).astype(int), (x // CELL).astype(int)] = True
    free = (value > 0) & ~torch.from_numpy(taken[:down, :across])
    cell_row, cell_column = free.nonzero(as_tuple=True)
    place = at[free]
    return (cell_column * CELL + place % CELL).float(), (cell_row * CELL + place // CELL).float()


def _inverse_depths(
    camera: Camera, others: Sequence[Camera], poses: Sequence[Float], near: float, far: float
) -> tuple[torch.Tensor, list[float]]:
    """Inverse depths a STEP apart in the neighbour that moves the most, and each neighbour's pixels per step."""
    ends = np.array([[0.0, 0.0, near], [0.0, 0.0, far]])
    spans = []
    for other, pose in zip(others, poses, strict=True):
        local = ends @ pose[:3, :3].T + pose[:3, 3]
        z = np.maximum(local[:, 2], 1e-3 * near)
        x, y = local[:, 0] / z * other.fx, local[:, 1] / z * other.fy
        spans.append(float(np.hypot(x[1] - x[0], y[1] - y[0])))
    count = int(np.clip(np.ceil(max(spans) / STEP), 4 * BESIDE, MAX_DEPTHS))
    return torch.linspace(1.0 / far, 1.0 / near, count), [span / (count - 1) for span in spans]


def _scores(
    rays: torch.Tensor, patch: torch.Tensor, inverse: torch.Tensor, pose: Float, other: Shot
) -> torch.Tensor:
    """Correlation [n,depths] of patches [n,m] with what a neighbour shows at each depth; -1 where it shows nothing."""
    camera = other.camera
    K = np.diag([2.0 / camera.width, 2.0 / camera.height, 1.0]) @ camera.K
    K[:2] -= K[2]  # to the -1..1 of grid_sample
    turn = torch.from_numpy(K @ pose[:3, :3]).float()
    shift = torch.from_numpy(K @ pose[:3, 3]).float()
    # x = K (R ray / w + t) up to scale, at each inverse depth w.
    turned = (rays @ turn.T)[:, None]  # [n,1,m,3]
    moved = inverse[None, :, None] * shift[:, None, None, None]  # [3,1,depths,1]
    z = turned[..., 2] + moved[2]
    ahead = z[:, :, z.shape[2] // 2] > 1e-6
    grid = torch.stack([turned[..., 0] + moved[0], turned[..., 1] + moved[1]], dim=-1)
    grid /= z.clamp_min(1e-6)[..., None]
    middle = grid[:, :, grid.shape[2] // 2]
    shown = ahead & (middle.abs() < 1.0 - 2.0 * RADIUS / min(camera.width, camera.height)).all(-1)
    n, depths, m, _ = grid.shape
    taken = torch.nn.functional.grid_sample(
        other.grey[None, None], grid.reshape(1, n * depths, m, 2), padding_mode="border", align_corners=False
    ).reshape(n, depths, m)
    product = torch.bmm(taken, patch[:, :, None])[..., 0]
    spread = taken.var(dim=2, correction=0).clamp_min((0.5 * MIN_CONTRAST) ** 2)
    return torch.where(shown, product / (spread * m).sqrt(), -1.0)


def _peaks(
    scores: torch.Tensor, pixels: Sequence[float]
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """From scores [neighbours,n,depths]: best score [n] (NaN where it is not clear), its place in depths [n], which
    neighbours agree [neighbours,n], and by how many pixels these differ from it on average [n].
    """
    common = scores.topk(min(AGREE, len(scores)), dim=0).values.mean(0)
    best, at = common.max(dim=1)
    depths = common.shape[1]
    steps = torch.arange(depths)
    beside = (steps[None] - at[:, None]).abs() <= BESIDE
    rival = common.masked_fill(beside, -1.0).max(dim=1).values
    inner = (at > 0) & (at < depths - 1)
    left = common.gather(1, (at - 1).clamp_min(0)[:, None])[:, 0]
    right = common.gather(1, (at + 1).clamp_max(depths - 1)[:, None])[:, 0]
    # The top of the parabola through the three scores.
    shift = 0.5 * (left - right) / (left - 2.0 * best + right).clamp_max(-1e-6)
    place = at + shift.clamp(-0.5, 0.5)
    own_score, own = scores.masked_fill(~beside[None], -1.0).max(dim=2)
    agreeing = own_score >= MIN_SCORE
    away = (own - at[None]).abs() * torch.tensor(pixels)[:, None]
    count = agreeing.sum(0)
    error = (away * agreeing).sum(0) / count.clamp_min(1)
    good = inner & (best >= MIN_SCORE) & (best - rival >= CLEAR) & (count >= AGREE) & (error <= MAX_ERROR)
    return torch.where(good, best, torch.nan), place, agreeing, error
