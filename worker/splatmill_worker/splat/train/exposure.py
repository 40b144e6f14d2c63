"""An affine colour per photo, for photos whose exposure or white balance differ."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor

PULL = 1e-3
"""Weight of the squared distance from the identity: without it, scene and photos could drift apart together."""

RATE = 1e-3


class Exposure:
    """A matrix [3, 3] and an offset [3] per photo, applied to the rendered colour before the loss.

    They start as the identity and are pulled towards it, so that the scene keeps the photos' mean exposure,
    which is the one that held-out views are judged with.
    """

    def __init__(self, photos: int) -> None:
        self.affine = torch.eye(3, 4).repeat(photos, 1, 1).requires_grad_()
        self._adam = torch.optim.Adam([self.affine], lr=RATE)

    def applied(self, photo: int, color: Tensor) -> Tensor:
        """Colour [H, W, 3] as photo number `photo` would have taken it."""
        affine = self.affine[photo].to(color.device)
        return color @ affine[:, :3].T + affine[:, 3]

    def penalty(self, photo: int) -> Tensor:
        """To be added to the loss."""
        return PULL * (self.affine[photo] - torch.eye(3, 4)).square().sum()

    def update(self, scale: float) -> None:
        """One Adam step with the rate times `scale`, from the gradients that the loss left."""
        for group in self._adam.param_groups:
            group["lr"] = RATE * scale
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        # A copy: Adam's own dictionary goes on changing.
        return {"affine": self.affine.detach().clone(), "adam": copy.deepcopy(self._adam.state_dict())}

    def restore(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        with torch.no_grad():
            self.affine.copy_(state["affine"])
        self._adam.load_state_dict(copy.deepcopy(state["adam"]))
