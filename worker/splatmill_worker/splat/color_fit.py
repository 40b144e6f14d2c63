"""The affine map of colours that brings a rendered image closest to its photo: what a camera's light leaves open."""

from __future__ import annotations

import torch
from torch import Tensor

NEGLIGIBLE = 1e-9
"""Share of the largest eigenvalue below which a direction of the normal equations is left out: an image of one colour
determines one offset per channel and no matrix."""


def color_fitted(image: Tensor, photo: Tensor) -> Tensor:
    """Return colours [n, 3] under the affine map, 3 x 3 matrix and offset, that is closest to `photo` [n, 3].

    The twelve numbers minimise the sum of squared differences over all n pixels (linear least squares, solved in
    float64 through the normal equations). Among several solutions the one nearest to the identity is taken, so that
    the fitted image is never farther from the photo than `image` is. Values are clamped to 0 to 1 afterwards.
    """
    return changed(image, color_change(image, photo))


def color_change(image: Tensor, photo: Tensor) -> Tensor:
    """What that map adds to a colour, float64 [4, 3]: three rows for red, green and blue, and the offset."""
    known = _with_one(image).double()
    missing = (photo - image).double()
    values, vectors = torch.linalg.eigh(known.T @ known)
    kept = values > NEGLIGIBLE * values[-1]
    inverse = torch.where(kept, 1.0 / torch.where(kept, values, torch.ones_like(values)), 0.0)
    change: Tensor = vectors @ (inverse[:, None] * (vectors.T @ (known.T @ missing)))
    return change


def changed(image: Tensor, change: Tensor) -> Tensor:
    """Colours [n, 3] with a `color_change` [4, 3] added, clamped to 0 to 1."""
    fitted: Tensor = image + (_with_one(image).double() @ change).to(image.dtype)
    return fitted.clamp(0.0, 1.0)


def _with_one(image: Tensor) -> Tensor:
    return torch.cat([image, torch.ones_like(image[:, :1])], dim=1)
