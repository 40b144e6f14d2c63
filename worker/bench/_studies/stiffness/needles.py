"""Gauss-Newton blocks of single needles: how far apart their eigenvalues are, in three metrics.

A needle of fixed length (4 pixels of standard deviation) gets thinner: its other two standard deviations are 0.8 and
0.5 times its length over the axis ratio. Five cameras look at it. J is the derivative of all their pixels by its 11
values (position 3, log-scale 3, quaternion 4, logit-opacity 1), J^T J the block. Colour is left out: of a single
Gaussian before a constant background it moves every pixel as the opacity does, so that the block would be singular.

The quaternion's length changes no pixel, and one eigenvalue of the 11 is 0; condition numbers are those of the other
ten.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from _rows import Row
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.pipeline.training import EXTENT
from splatmill_worker.splat.plan.rates import RateSchedule
from splatmill_worker.synthetic import look_at

RATIOS = [1.0, 3.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6]
LENGTH, SIDE, FOCAL, DISTANCE = 4.0, 32, 64.0, 3.0
"""Standard deviation along the needle, side of the images and focal length in pixels; distance of the cameras."""

VALUES = 11
EYES = [(1.0, 0.2, 0.1), (-0.3, 1.0, 0.4), (0.2, -0.4, 1.0), (-0.8, -0.7, 0.3), (0.6, -0.6, -0.5)]
TURN = (0.5, 0.5, -0.3, 0.4)


def needle(ratio: float) -> Tensor:
    """The eleven values of a needle, float64."""
    length = LENGTH * DISTANCE / FOCAL
    scales = torch.tensor([length, 0.8 * length / ratio, 0.5 * length / ratio], dtype=torch.float64)
    quat = torch.tensor(TURN, dtype=torch.float64)
    parts = [torch.tensor([0.02, -0.03, 0.01], dtype=torch.float64), scales.log(), quat / quat.norm()]
    return torch.cat([*parts, torch.zeros(1, dtype=torch.float64)])


def images(values: Tensor) -> Tensor:
    """All pixels of all cameras, one dimension."""
    color = torch.full((1, 16, 3), 0.0, dtype=torch.float64)
    color[0, 0] = torch.tensor([1.0, 0.2, -0.7], dtype=torch.float64)
    pixels = []
    for eye in EYES:
        camera = look_at(DISTANCE * np.array(eye) / np.linalg.norm(eye), np.zeros(3), SIDE, SIDE, FOCAL)
        viewmat, K = torch.as_tensor(camera.viewmat), torch.as_tensor(camera.K)
        splats = ops.project(
            values[None, :3], values[None, 3:6], values[None, 6:10], values[10:], color, viewmat.double(), K.double(),
            SIDE, SIDE, degree=0, backend="reference",
        )  # fmt: skip
        bins = ops.bin(splats, SIDE, SIDE, backend="reference")
        pixels.append(ops.composite(splats, bins, SIDE, SIDE, backend="reference")[0].reshape(-1))
    return torch.cat(pixels)


def jacobian(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """The derivative of a function of one dimension, column by column: J^T w is linear in w, and its derivative by w in
    a direction v is J v."""
    leaf = at.detach().clone().requires_grad_()
    reached = function(leaf)
    w = torch.zeros_like(reached, requires_grad=True)
    (pulled,) = torch.autograd.grad(reached, leaf, w, create_graph=True)
    columns = [torch.autograd.grad(value, w, retain_graph=True)[0] for value in pulled]
    return torch.stack(columns, 1)


def in_own_axes(values: Tensor) -> Tensor:
    """[11, 10]: motions of the values when the needle moves along, and turns about, its own axes."""
    w, x, y, z = values[6:10].tolist()
    # Right multiplication by the imaginary units: turns about the axes of the needle, of 2 radians per unit.
    turns = torch.tensor([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]], dtype=torch.float64)
    rotation = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        dtype=torch.float64,
    )
    frame = torch.zeros(VALUES, 10, dtype=torch.float64)
    frame[:3, :3] = rotation
    frame[3:6, 3:6] = torch.eye(3, dtype=torch.float64)
    frame[6:10, 6:9] = 0.5 * turns
    frame[10, 9] = 1.0
    return frame


def measure(ratio: float) -> list[Row]:
    """A row for each metric: largest eigenvalue, condition number, index of the value that is flattest."""
    values = needle(ratio)
    J = jacobian(images, values)
    frame = in_own_axes(values)
    lengths = J.norm(dim=0)
    rates = torch.tensor(RateSchedule(EXTENT).at(0.0).rows()[:VALUES], dtype=torch.float64)
    own = J @ frame
    scaled = {
        "none": J,
        # Where residuals are noise, the second moments are in proportion to the diagonal of J^T J.
        "Adam": J * torch.sqrt(rates / lengths),
        "Jacobi": J / lengths,
        "Jacobi, own axes": own / own.norm(dim=0),
    }
    rows: list[Row] = []
    for metric, columns in scaled.items():
        _, singular, right = torch.linalg.svd(columns, full_matrices=False)
        rows.append(
            {
                "part": "needles",
                "ratio_of": ratio,
                "metric": metric,
                "largest": float(singular[0]) ** 2,
                "condition": float(singular[0] / singular[9]) ** 2,
                "flattest": int(right[9].abs().argmax()),
            }
        )
    return rows
