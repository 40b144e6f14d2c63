"""The part of a photo is a photo of its own, which knows the whole."""

from __future__ import annotations

import numpy as np
import torch

from splatmill_worker.kernels.records import PartOf
from splatmill_worker.scene import Camera
from splatmill_worker.splat.views import Target, TrainingView
from splatmill_worker.tiles.visibility import Part


def view(mask: torch.Tensor | None) -> TrainingView:
    camera = Camera(64, 48, 50.0, 60.0, 32.0, 24.0, np.eye(4))
    rgb = torch.arange(48 * 64 * 3).remainder(256).to(torch.uint8).reshape(48, 64, 3)
    return TrainingView("a.jpg", {1: Target.of(camera, rgb, None, mask)})


def test_a_part_has_the_pixels_of_the_photo_and_its_size() -> None:
    counted = torch.ones(16, 32, dtype=torch.bool)
    counted[:, :8] = False
    part, whole = Part(16, 32, 48, 48, counted), view(None)
    cut = part.of(whole).full
    assert torch.equal(cut.rgb, whole.full.rgb[32:48, 16:48])
    assert cut.mask is not None
    assert torch.equal(cut.mask, counted)
    assert (cut.camera.cx, cut.camera.cy) == (16.0, -8.0)
    assert cut.part_of == PartOf(64, 48, 64 * 48)
    assert part.of(whole).reduced(2).part_of == PartOf(32, 24, 32 * 24)


def test_the_mask_of_the_photo_holds_in_a_part() -> None:
    mask = torch.ones(48, 64, dtype=torch.bool)
    mask[:, 40:] = False
    part = Part(16, 32, 48, 48, torch.ones(16, 32, dtype=torch.bool))
    masked = part.of(view(mask)).full
    assert masked.mask is not None
    assert int(masked.mask.sum()) == 16 * 24
    assert masked.part_of == PartOf(64, 48, 48 * 40)
    assert not part.counted_of(view(torch.zeros(48, 64, dtype=torch.bool))).any()
