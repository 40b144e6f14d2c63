"""A street of two colours, photographed by cameras side by side: sky above, bricks below."""

from __future__ import annotations

import numpy as np
import torch

from splatmill_worker.scene import Camera
from splatmill_worker.splat.views import Target, TrainingView

WIDTH, HEIGHT = 96, 64
BLUE, BRICK = (90, 140, 230), (140, 80, 60)


def street(x: float = 0.0, mask: torch.Tensor | None = None) -> TrainingView:
    """A photo from the position (x, 0, 0), with a focal length of 80 pixels; blue above, brick below."""
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    camera = Camera(WIDTH, HEIGHT, 80.0, 80.0, WIDTH / 2, HEIGHT / 2, viewmat)
    rgb = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    rgb[: HEIGHT // 2] = torch.tensor(BLUE, dtype=torch.uint8)
    rgb[HEIGHT // 2 :] = torch.tensor(BRICK, dtype=torch.uint8)
    target = Target(camera, torch.eye(4), torch.as_tensor(camera.K), rgb, None, mask)
    return TrainingView(f"{x}", {1: target})


def right_half() -> torch.Tensor:
    """A mask that keeps the right half of a photo."""
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, : WIDTH // 2] = False
    return mask
