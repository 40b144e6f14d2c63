"""LPIPS: a distance of pictures by the features of an image network, version 0.1, of VGG-16 and of AlexNet.

Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", 2018. The package `lpips`
computes the same, but needs torchvision, which ties the version of torch.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from splatmill_worker.splat.lpips_weights import read_weights

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""With SHIFT, what colours in -1 to 1 are normalised by: ImageNet's mean and deviation, as LPIPS was trained with."""

NORM_FLOOR = 1e-10
"""Added to the length of a pixel's features before they are divided by it, as LPIPS was trained with."""

LEAST_SIDE = 31
"""Least pixels of a side, so that a pixel is left in the last stage of AlexNet; VGG-16 needs 16."""

STRIP_PIXELS = 2**19
"""Pixels of a strip of rows that is computed at once, beside its margins: the features of the first stage of VGG-16
take 256 bytes each."""

ALIGNED = 16
"""Rows of a picture for one of the last stage. Strips begin at a multiple of them."""

MARGIN = 7 * ALIGNED
"""Rows above and below a strip that its features depend on: 98 for VGG-16, 97 for AlexNet."""


class Convolution(NamedTuple):
    """A convolution with a ReLU behind it: channels that it makes, side of its kernel, stride and zero padding."""

    channels: int
    side: int = 3
    stride: int = 1
    padding: int = 1


class Stage(NamedTuple):
    """The layers between two comparisons: a maximum over windows of `pooled` pixels, with a stride of 2 (0: none), and
    then convolutions.
    """

    pooled: int
    convolutions: tuple[Convolution, ...]

    @property
    def stride(self) -> int:
        """Rows of its input for one of its output."""
        return (2 if self.pooled else 1) * max(each.stride for each in self.convolutions)


def _of(*channels: int) -> tuple[Convolution, ...]:
    return tuple(Convolution(each) for each in channels)


VGG16 = (
    Stage(0, _of(64, 64)),
    Stage(2, _of(128, 128)),
    Stage(2, _of(256, 256, 256)),
    Stage(2, _of(512, 512, 512)),
    Stage(2, _of(512, 512, 512)),
)
"""Simonyan and Zisserman 2015, configuration D."""

ALEXNET = (
    Stage(0, (Convolution(64, 11, 4, 2),)),
    Stage(3, (Convolution(192, 5, 1, 2),)),
    Stage(3, _of(384)),
    Stage(0, _of(256)),
    Stage(0, _of(256)),
)
"""Krizhevsky 2014, "One weird trick for parallelizing convolutional neural networks"."""


@dataclass(frozen=True)
class Lpips:
    """The metric by one network.

    stages: of the network.
    layers: kernel [out, in, side, side] and bias [out] of every convolution, in order.
    heads: weight [1, channels, 1, 1] of every channel of the features after each stage.
    """

    stages: tuple[Stage, ...]
    layers: tuple[tuple[Tensor, Tensor], ...]
    heads: tuple[Tensor, ...]

    @staticmethod
    def vgg() -> Lpips:
        """The metric by VGG-16, in most papers on splats. Raises ValueError as `read_weights` does."""
        return Lpips._read("vgg16", "VGG16_0", VGG16)

    @staticmethod
    def alex() -> Lpips:
        """The metric by AlexNet, at a twentieth of the work. Raises ValueError as `read_weights` does."""
        return Lpips._read("alexnet", "AlexNet_0", ALEXNET)

    @staticmethod
    def _read(file: str, trunk: str, stages: tuple[Stage, ...]) -> Lpips:
        shapes: dict[str, tuple[int, ...]] = {}
        inputs = 3
        for number, layer in enumerate(layer for stage in stages for layer in stage.convolutions):
            shapes[f"{trunk}/Conv_{number}/kernel"] = (layer.side, layer.side, inputs, layer.channels)
            shapes[f"{trunk}/Conv_{number}/bias"] = (layer.channels,)
            inputs = layer.channels
        for number, stage in enumerate(stages):
            shapes[f"NetLinLayer_{number}/Conv_0/kernel"] = (1, 1, stage.convolutions[-1].channels, 1)
        values = read_weights(file, shapes)
        kernels = [value.permute(3, 2, 0, 1).contiguous() for value in values if value.dim() == 4]
        biases = [value for value in values if value.dim() == 1]
        layers = tuple(zip(kernels[: len(biases)], biases, strict=True))
        return Lpips(stages, layers, tuple(kernels[len(biases) :]))

    def __call__(self, shown: Tensor, photo: Tensor) -> float:
        """The distance of two pictures, RGB [H, W, 3] in 0 to 1; 0 for equal ones. Sides from LEAST_SIDE pixels.

        It is computed in strips of rows whose features are those of the whole picture.
        """
        height, width = photo.shape[:2]
        shift, scale = (photo.new_tensor(each)[:, None, None] for each in (SHIFT, SCALE))
        pictures = [
            (2.0 * picture.float().permute(2, 0, 1)[None] - 1.0 - shift) / scale for picture in (shown, photo)
        ]
        rows = max(ALIGNED, STRIP_PIXELS // width // ALIGNED * ALIGNED)
        strides = list(accumulate((stage.stride for stage in self.stages), int.__mul__))
        sums, counts = [0.0] * len(strides), [0] * len(strides)
        for top in range(0, height, rows):
            first, bottom = max(0, top - MARGIN), top + rows
            strips = [picture[:, :, first : bottom + MARGIN] for picture in pictures]
            for number, errors in enumerate(self._errors(strips)):
                ends = None if bottom >= height else (bottom - first) // strides[number]
                own = errors[(top - first) // strides[number] : ends]
                sums[number] += float(own.double().sum())
                counts[number] += own.numel()
        return sum(total / count for total, count in zip(sums, counts, strict=True))

    @torch.no_grad()
    def _errors(self, pictures: list[Tensor]) -> Iterator[Tensor]:
        """The weighted squared differences [H, W] of the features of two pictures [1, 3, H, W], after each stage."""
        layers = iter(self.layers)
        for stage, head in zip(self.stages, self.heads, strict=True):
            if stage.pooled:
                pictures = [functional.max_pool2d(picture, stage.pooled, 2) for picture in pictures]
            for each in stage.convolutions:
                kernel, bias = (value.to(pictures[0].device) for value in next(layers))
                for number, picture in enumerate(pictures):
                    made = functional.conv2d(picture, kernel, bias, each.stride, each.padding)
                    pictures[number] = made.relu_()
            one, other = (picture / (picture.norm(dim=1, keepdim=True) + NORM_FLOOR) for picture in pictures)
            yield functional.conv2d((one - other).square_(), head.to(one.device))[0, 0]


class Distances(NamedTuple):
    """The metric by both networks."""

    vgg: Lpips
    alex: Lpips

    @staticmethod
    def read() -> Distances:
        """The installed networks. Raises ValueError as `read_weights` does."""
        return Distances(Lpips.vgg(), Lpips.alex())
