"""The second stage: the photos as tensors in the training world."""

from __future__ import annotations

from dataclasses import dataclass, replace

from splatmill_worker.images.load import load_views
from splatmill_worker.pipeline.cameras import Cameras
from splatmill_worker.splat.plan.light import Light
from splatmill_worker.splat.views import TrainingView


@dataclass(frozen=True)
class Photos:
    """The photos of both parts of the split as tensors, in the training world."""

    training: tuple[TrainingView, ...]
    held_out: tuple[TrainingView, ...]

    @property
    def shown(self) -> TrainingView:
        """The view of previews and of the progress film: a held-out one where there is any."""
        return (self.held_out or self.training)[0]

    def relit(self, light: Light) -> Photos:
        """The photos, with those to train on brought to the light of the photos around them.

        light: of the training photos, in their order, measured at any size of them.

        Held-out photos stay as they are: to fit them to the model would flatter the score.
        """
        changes = zip(self.training, light.departures, strict=True)
        return replace(self, training=tuple(view.relit(departure) for view, departure in changes))


def load_photos(cameras: Cameras, size: int) -> Photos:
    """All photos, undistorted, with `size` pixels at most on the longer side."""
    training, held_out = (
        tuple(TrainingView.of(photo, cameras.normalization) for photo in load_views(views, size))
        for views in (cameras.training, cameras.held_out)
    )
    return Photos(training, held_out)
