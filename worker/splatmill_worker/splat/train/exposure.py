"""Fitted exposures: an affine colour per photo, for photos whose exposure or white balance differ."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor

PULL = 1e-3
"""Weight of the squared distance from the identity in the loss. Without it, the colours of the scene and of all photos
could drift together."""

RATE = 1e-3
"""Adam's rate, per step on the photo."""


class Exposure:
    """A matrix [3, 3] and an offset [3] per photo, applied to the rendered colour before the loss.

    They start as the identity and are pulled towards it, so that the scene keeps the photos' mean exposure, at which
    the held-out views are evaluated.
    """

    def __init__(self, photos: int) -> None:
        self.affine = torch.eye(3, 4).repeat(photos, 1, 1).requires_grad_()
        self._adam = torch.optim.Adam([self.affine], lr=RATE)

    def applied(self, photo: int, color: Tensor) -> Tensor:
        """Rendered colour [H, W, 3] at the exposure of photo number `photo`."""
        affine = self.affine[photo].to(color.device)
        return color @ affine[:, :3].T + affine[:, 3]

    def penalty(self, photo: int) -> Tensor:
        """The term of the loss that pulls the exposure of photo number `photo` towards the identity."""
        return PULL * (self.affine[photo] - torch.eye(3, 4)).square().sum()

    def update(self, scale: float) -> None:
        """Take one Adam step with the rate times `scale`, from the gradients that the loss left."""
        for group in self._adam.param_groups:
            group["lr"] = RATE * scale
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def state(self) -> dict[str, Any]:
        """Copies of the exposures and of Adam's state, for a snapshot."""
        return {"affine": self.affine.detach().clone(), "adam": copy.deepcopy(self._adam.state_dict())}

    def restore(self, state: dict[str, Any]) -> None:
        """Take over what `state()` returned."""
        with torch.no_grad():
            self.affine.copy_(state["affine"])
        self._adam.load_state_dict(copy.deepcopy(state["adam"]))
