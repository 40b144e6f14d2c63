"""A small scene of repeated textures in 3D, trained from its true cameras with waves and without.

Waves pay in equal steps and not in equal time (decisions: gabor-3d).

In 3D a wave is a plane wave of frequency f (cycles per world unit) through the centre of its Gaussian. Where a ray
meets the Gaussian, the expected place is mu + Sigma M^T C d, with d the offset in the image, C the conic and M = J W.
The wave in the image then has the frequency C M Sigma f, which is what is drawn. Its fading across thick
Gaussians is left out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from splatmill_worker.fit_image import gabor
from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import GROUPS, NYQUIST, Projected, Waves
from splatmill_worker.kernels.reference.project import rotation
from splatmill_worker.scene import Camera
from splatmill_worker.splat.gaussians import SH_C0
from splatmill_worker.synthetic import ray_caster

PLAIN, WAVE = 14, 7
"""Parameters of a Gaussian of SH degree 0, and of a wave in 3D."""

SIDE, SAMPLES, FOCAL = 96, 3, 110.0
"""Pixels of the views both ways, samples of a pixel both ways, focal length in pixels."""

UNIT = 30.0
"""Unit of the frequencies that Adam moves, cycles per world unit: its rate is then that of phases and amplitudes."""

WAVE_RATE = 2e-2

BEGUN_AT = (0.15, 0.3, 0.45)
"""Shares of the steps at which Gaussians get waves."""


class Views(NamedTuple):
    """Pictures [V, SIDE, SIDE, 3] uint8, viewmats [V, 4, 4] and the intrinsics K [3, 3]."""

    pictures: Tensor
    viewmats: Tensor
    K: Tensor


def views(count: int) -> Views:
    """The scene from `count` cameras around it: a woven floor of 2 x 2, and a striped ball on it."""
    pictures, viewmats = [], []
    for i in range(count):
        angle, height = 2.0 * math.pi * i * 0.381966, 0.9 + 0.7 * (i % 5) / 4.0
        eye = np.array([2.0 * math.cos(angle), 2.0 * math.sin(angle), height])
        camera = ray_caster.look_at(eye, np.array([0.0, 0.0, 0.15]), SIDE, SIDE, FOCAL)
        pictures.append(torch.from_numpy(_photo(camera)))
        viewmats.append(torch.from_numpy(np.asarray(camera.viewmat)).float())
    K = torch.tensor([[FOCAL, 0.0, SIDE / 2], [0.0, FOCAL, SIDE / 2], [0.0, 0.0, 1.0]])
    return Views(torch.stack(pictures), torch.stack(viewmats), K)


def _photo(camera: Camera) -> np.ndarray:
    y, x = (np.mgrid[0 : SIDE * SAMPLES, 0 : SIDE * SAMPLES] + 0.5) / SAMPLES
    rays = np.stack([(x - SIDE / 2) / FOCAL, (y - SIDE / 2) / FOCAL, np.ones_like(x)], -1)
    turn, shift = np.asarray(camera.viewmat)[:3, :3], np.asarray(camera.viewmat)[:3, 3]
    eye = -turn.T @ shift
    rays = rays @ turn
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    colors = np.ones_like(rays)
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = -eye[2] / rays[..., 2]
    at = eye[:2] + floor[..., None] * rays[..., :2]
    on = (floor > 0) & (np.abs(at) < 1.0).all(-1)
    colors = np.where(on[..., None], _woven(at), colors)
    centre = np.array([0.0, 0.0, BALL])
    b = rays @ (eye - centre)
    root = b * b - (eye - centre) @ (eye - centre) + BALL * BALL
    near = -b - np.sqrt(np.maximum(root, 0.0))
    normal = (eye + near[..., None] * rays - centre) / BALL
    colors = np.where((root > 0)[..., None], _striped(normal), colors)
    mean = colors.reshape(SIDE, SAMPLES, SIDE, SAMPLES, 3).mean(axis=(1, 3))
    pixels: np.ndarray = (mean * 255.0).round().astype(np.uint8)
    return pixels


BALL = 0.35
"""Radius of the ball, world units."""


def _woven(at: np.ndarray) -> np.ndarray:
    cell = np.floor(at / 0.125)
    over = (cell.sum(-1) % 2 == 0)[..., None]
    u, v = np.moveaxis(at / 0.125 - cell - 0.5, -1, 0)
    shade = np.where(over[..., 0], 1 - 2.2 * u * u, 1 - 2.2 * v * v)
    color: np.ndarray = np.where(over, (0.75, 0.6, 0.4), (0.45, 0.3, 0.2)) * shade[..., None]
    return color


def _striped(normal: np.ndarray) -> np.ndarray:
    swing = 0.5 + 0.5 * np.cos(2.0 * math.pi * 6.0 * normal[..., 2:])
    color: np.ndarray = np.array([0.2, 0.25, 0.5]) + swing * np.array([0.65, 0.55, 0.3])
    return color


def trained(views: Views, count: int, steps: int, seed: int, *, waves: bool) -> dict[str, float]:
    """Train with the parameters of `count` plain Gaussians on all views but every 5th; the fields of the row."""
    random = torch.Generator().manual_seed(seed)
    number = int(count * PLAIN / (PLAIN + gabor.SHARE * WAVE)) if waves else count
    model = _Model(number, random)
    held = torch.arange(len(views.pictures)) % 5 == 0
    used = torch.nonzero(~held).squeeze(1).tolist()
    stats = {i: ops.photo_stats(views.pictures[i]) for i in used}
    due = list(BEGUN_AT) if waves else []
    for step in range(1, steps + 1):
        progress = (step - 1) / steps
        if due and progress >= due[0]:
            due.pop(0)
            model.begin(views, used)
        i = used[int(torch.randint(len(used), (), generator=random))]
        color = model.render(views.viewmats[i], views.K)
        loss = ops.loss(color, views.pictures[i], stats=stats[i])
        loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        model.move(0.02 + 0.98 * 0.5 * (1.0 + math.cos(math.pi * progress)))
    with torch.no_grad():
        shown = [model.render(views.viewmats[i], views.K).clamp(0, 1) for i in torch.nonzero(held).flatten()]
    errors = [
        float((a - b.float() / 255.0).square().mean())
        for a, b in zip(shown, views.pictures[held], strict=True)
    ]
    given = int((model.rows >= 0).sum())
    return {
        "gaussians": number,
        "waves": given,
        "parameters": PLAIN * number + WAVE * given,
        "psnr": round(sum(-10.0 * math.log10(e) for e in errors) / len(errors), 3),
    }


class _Model:
    """Gaussians on the surfaces, waves of some of them, and Adam."""

    def __init__(self, count: int, random: torch.Generator) -> None:
        ball = count // 5
        direction = torch.nn.functional.normalize(torch.randn(ball, 3, generator=random), dim=1)
        floor = torch.cat(
            [2.0 * torch.rand(count - ball, 2, generator=random) - 1.0, torch.zeros(count - ball, 1)], 1
        )
        means = torch.cat([direction * BALL + torch.tensor([0.0, 0.0, BALL]), floor])
        width = 0.5 * math.sqrt(4.0 / max(1, count - ball))
        self.groups = {
            "means": means,
            "log_scales": torch.full((count, 3), math.log(width)),
            "quats": torch.randn(count, 4, generator=random),
            "logit_opacities": torch.full((count,), 0.5),
            "sh": torch.zeros(count, 1, 3),
            "waves": torch.zeros(count, WAVE),  # frequency 3 in UNIT, phase in turns, amplitude 3
        }
        self.rows = torch.full((count,), -1, dtype=torch.int32)
        for value in self.groups.values():
            value.requires_grad_()
        rates = {
            "means": 2e-3,
            "log_scales": 1e-2,
            "quats": 1e-2,
            "logit_opacities": 3e-2,
            "sh": 1e-2 / SH_C0,
        }
        own = [{"params": [self.groups[name]], "lr": rate, "rate": rate} for name, rate in rates.items()]
        own.append({"params": [self.groups["waves"]], "lr": WAVE_RATE, "rate": WAVE_RATE})
        self.adam = torch.optim.Adam(own, eps=1e-15)

    def project(self, viewmat: Tensor, K: Tensor) -> Projected:
        means, log_scales, quats, logit_opacities, sh = (self.groups[name] for name in GROUPS)
        return ops.project(means, log_scales, quats, logit_opacities, sh, viewmat, K, SIDE, SIDE, degree=0)

    def render(self, viewmat: Tensor, K: Tensor) -> Tensor:
        projected = self.project(viewmat, K)
        lists = ops.bin(projected, SIDE, SIDE)
        waves = None
        if (self.rows >= 0).any():
            given = torch.nonzero(self.rows >= 0).squeeze(1)
            values = self.groups["waves"][given]
            frequency = torch.einsum(
                "nij,nj->ni", self.carried(projected.conics[given], given, viewmat), UNIT * values[:, :3]
            )
            number = torch.full_like(self.rows, -1)
            number[given] = torch.arange(len(given), dtype=torch.int32)
            waves = Waves(torch.cat([frequency, values[:, 3:]], 1), number)
        color, _, _ = ops.composite(projected, lists, SIDE, SIDE, background=torch.ones(3), waves=waves)
        return color

    def carried(self, conics: Tensor, rows: Tensor, viewmat: Tensor) -> Tensor:
        """C M Sigma of Gaussians [R, 2, 3]: takes frequencies of the world to the image."""
        turn, shift = viewmat[:3, :3], viewmat[:3, 3]
        x, y, z = (self.groups["means"][rows] @ turn.T + shift).unbind(1)
        row0 = (FOCAL / z)[:, None] * (turn[0] - (x / z)[:, None] * turn[2])
        row1 = (FOCAL / z)[:, None] * (turn[1] - (y / z)[:, None] * turn[2])
        across = torch.stack([row0, row1], 1)
        factor = rotation(self.groups["quats"][rows]) * self.groups["log_scales"][rows].exp()[:, None, :]
        a, b, c = conics.unbind(1)
        conic = torch.stack([torch.stack([a, b], 1), torch.stack([b, c], 1)], 1)
        carried: Tensor = conic @ across @ factor @ factor.transpose(1, 2)
        return carried

    @torch.no_grad()
    def begin(self, views: Views, used: list[int]) -> None:
        """Give waves to those Gaussians under which one explains most, in the view that shows them largest."""
        count = len(self.rows)
        most, found = torch.full((count,), -1.0), torch.zeros(count, WAVE)
        largest = torch.zeros(count)
        for i in used[:: max(1, len(used) // 8)]:
            projected = self.project(views.viewmats[i], views.K)
            residual = views.pictures[i].float() / 255.0 - self.render(views.viewmats[i], views.K)
            size = projected.extents.prod(1)
            better = torch.nonzero(size > largest).squeeze(1)
            if not len(better):
                continue
            energy, values = gabor.strongest(Projected(*(field[better] for field in projected)), residual)
            carried = self.carried(projected.conics[better], better, views.viewmats[i])
            world = torch.einsum("nij,nj->ni", torch.linalg.pinv(carried), values[:, :2])
            good = world.isfinite().all(1) & (values[:, :2].abs().amax(1) < NYQUIST)
            largest[better[good]], most[better[good]] = size[better[good]], energy[good]
            found[better[good]] = torch.cat([world / UNIT, values[:, 2:]], 1)[good]
        most[self.rows >= 0] = -1.0
        wanted = int(gabor.SHARE * count) - int((self.rows >= 0).sum())
        if wanted <= 0:
            return
        chosen = most.topk(wanted).indices
        chosen = chosen[most[chosen] > 0]
        self.groups["waves"].data[chosen] = found[chosen]
        self.rows[chosen] = 0

    def move(self, fall: float) -> None:
        for group in self.adam.param_groups:
            group["lr"] = fall * group["rate"]
        for value in self.groups.values():
            if value.grad is not None:
                value.grad.nan_to_num_(0.0, 0.0, 0.0)
        waves = self.groups["waves"]
        if waves.grad is not None:
            waves.grad[self.rows < 0] = 0.0
        self.adam.step()
        self.adam.zero_grad()
