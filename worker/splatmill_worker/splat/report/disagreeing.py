"""The training photos that disagree with the others, as the report shows them: ranked, with reasons and pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from splatmill_worker.splat.train.disagreement import Disagreement
from splatmill_worker.splat.train.loop import Trained
from splatmill_worker.splat.views import TrainingView

MOST_NAMED = 12
"""Photos in the table of the page."""

PICTURED = 4
"""Photos that the page shows, with what disagrees marked."""

MARK = (230, 30, 60)
"""Colour that is laid over pixels that no other photo agrees with, of 255."""

MARKED = 0.55
"""Share of that colour in these pixels."""


@dataclass(frozen=True)
class MarkedPhoto:
    """A photo with the pixels that disagree marked.

    caption: its name, and what the disagreement looks like.
    picture: uint8 [H, W, 3].
    """

    caption: str
    picture: Tensor


def rows(trained: Trained) -> list[dict[str, Any]]:
    """All training photos as plain values, in order of decreasing disagreement."""
    return [
        {
            "photo": each.name,
            "decibels": each.decibels,
            "share": each.share,
            "reason": each.reason,
        }
        for each in trained.disagreements
    ]


def named(trained: Trained) -> list[Disagreement]:
    """The photos whose disagreement has a reason, in order of decreasing disagreement; MOST_NAMED at most."""
    return [each for each in trained.disagreements if each.reason is not None][:MOST_NAMED]


def marked(trained: Trained) -> list[MarkedPhoto]:
    """The first PICTURED of the named photos that show something that no other photo agrees with."""
    views = {view.name: view for view in trained.views}
    shown = [each for each in named(trained) if each.share > 0.0]
    return [
        MarkedPhoto(f"{each.name}: {each.reason}", marked_photo(views[each.name], each.outliers))
        for each in shown[:PICTURED]
    ]


def marked_photo(view: TrainingView, region: Tensor) -> Tensor:
    """The photo uint8 [H, W, 3] with a `region` [h, w] of it marked."""
    photo = view.full.rgb
    large = torch.nn.functional.interpolate(region[None, None].float(), size=photo.shape[:2], mode="nearest")[
        0, 0, :, :, None
    ]
    tint = MARKED * large
    mixed: Tensor = (1.0 - tint) * photo.float() + tint * torch.tensor(MARK, dtype=torch.float32)
    return mixed.to(torch.uint8)
