"""LPIPS of VGG-16 (Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", 2018),
version 0.1, with weights that the caller has. No weights are a part of the project, and none are fetched.

The package `lpips` does the same, but needs torchvision, which ties the version of torch.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

STAGES = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
"""Channels of VGG-16's convolutions of 3 x 3 (Simonyan and Zisserman 2015, configuration D), with a halving of the
picture between two stages. The features that are compared are those after each stage."""

LEAST_SIDE = 2 ** (len(STAGES) - 1)
"""Least pixels of a side, so that a pixel is left in the last stage."""

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""With SHIFT, what colours in -1 to 1 are normalised by: ImageNet's mean and deviation, as LPIPS was trained with."""

NORM_FLOOR = 1e-10
"""Added to the length of a pixel's features before they are divided by it, as LPIPS was trained with."""


class Lpips:
    """The metric with given weights.

    Raises ValueError, as a sentence, for files that do not hold them.
    """

    def __init__(self, vgg: Path, linear: Path) -> None:
        """vgg: a state dict of VGG-16 as torchvision publishes it. linear: one of LPIPS, as its package has it."""
        trunk, heads = _state(vgg, "VGG-16's weights"), _state(linear, "LPIPS's linear weights")
        self._stages: list[list[tuple[Tensor, Tensor]]] = []
        self._heads: list[Tensor] = []
        layer, channels = 0, 3
        for number, widths in enumerate(STAGES):
            stage = []
            for width in widths:
                weight = _tensor(trunk, vgg, f"features.{layer}.weight", (width, channels, 3, 3))
                stage.append((weight, _tensor(trunk, vgg, f"features.{layer}.bias", (width,))))
                layer, channels = layer + 2, width  # a ReLU follows each convolution
            layer += 1  # and a pooling each stage
            self._stages.append(stage)
            self._heads.append(_tensor(heads, linear, f"lin{number}.model.1.weight", (1, channels, 1, 1)))

    def __call__(self, shown: Tensor, photo: Tensor) -> float:
        """The distance of two pictures, RGB [H, W, 3] in 0 to 1; 0 for equal ones. Sides from LEAST_SIDE pixels."""
        shift, scale = (torch.tensor(each)[:, None, None] for each in (SHIFT, SCALE))
        both = torch.stack([picture.float().permute(2, 0, 1) for picture in (shown, photo)])
        features, total = (2.0 * both - 1.0 - shift) / scale, 0.0
        with torch.no_grad():
            for number, (stage, head) in enumerate(zip(self._stages, self._heads, strict=True)):
                if number:
                    features = functional.max_pool2d(features, 2)
                for weight, bias in stage:
                    features = functional.relu(functional.conv2d(features, weight, bias, padding=1))
                unit = features / (features.norm(dim=1, keepdim=True) + NORM_FLOOR)
                total += float(functional.conv2d((unit[:1] - unit[1:]).square(), head).mean())
        return total


def _state(path: Path, what: str) -> dict[str, Tensor]:
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, KeyError) as error:
        raise ValueError(f"{what} could not be read from {path}: {error}") from error
    except Exception as error:  # torch.load raises pickle's own errors, whose text advises to trust the file
        raise ValueError(f"{what} could not be read from {path}: it is no file of tensors alone.") from error
    if not isinstance(state, dict):
        raise ValueError(
            f"{what} could not be read from {path}: it holds a {type(state).__name__}, no state dict."
        )
    return state


def _tensor(state: dict[str, Tensor], path: Path, name: str, shape: tuple[int, ...]) -> Tensor:
    found = state.get(name)
    if not isinstance(found, Tensor) or tuple(found.shape) != shape:
        has = tuple(found.shape) if isinstance(found, Tensor) else "nothing"
        raise ValueError(f"{path} has {has} as {name}; {shape} is needed.")
    return found.float()
