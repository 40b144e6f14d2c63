"""The finished scene as files, in the world that the cameras came in."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from splatmill.schema import CameraSpec, ModelCamera, ModelCameras
from splatmill_worker.scene import Camera, Normalization, Scene
from splatmill_worker.splat import ply
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train.loop import Trained
from splatmill_worker.splat.views import TrainingView

FAR = 1e4
"""Distance from the origin over the cameras' radius from which float32 coordinates lose what photos resolve."""


@dataclass(frozen=True)
class Frame:
    """From the training world to the exported one: world = (trained - translation) / scale - offset.

    `offset` is zero except for scenes far from their origin (geo-referenced ones), which keep local coordinates.
    """

    normalization: Normalization
    offset: npt.NDArray[np.float64]

    @staticmethod
    def of(normalization: Normalization, scene: Scene) -> Frame:
        """The scene's own world, or a local one where float32 could not hold it."""
        middle = scene.centers.mean(axis=0)
        far = float(np.linalg.norm(middle)) * normalization.scale > FAR
        return Frame(normalization, np.round(middle) if far else np.zeros(3))

    def camera(self, camera: Camera) -> Camera:
        """A camera of the training world in the exported world."""
        home = self.normalization.undo_camera(camera)
        return home.moved_to(home.center - self.offset)


def export(
    out: Path,
    trained: Trained,
    plan: Plan,
    frame: Frame,
    views: Sequence[TrainingView],
    held_out: Sequence[TrainingView],
) -> int:
    """Write model.ply and cameras.json into `out`; returns the number of Gaussians written."""
    scale = 1.0 / frame.normalization.scale
    shift = -scale * frame.normalization.translation - frame.offset
    home = trained.gaussians.moved(scale, torch.from_numpy(shift))
    comments = ["Made by Splatmill"]
    if frame.offset.any():
        comments.append("offset " + " ".join(f"{value:.0f}" for value in frame.offset))
    written = ply.write(out / "model.ply", home, degree=plan.schedule.degree, comments=tuple(comments))
    errors = {} if trained.held_out is None else {view.name: view.psnr for view in trained.held_out.views}
    cameras = [
        ModelCamera(
            name=view.name,
            split=split,
            camera=spec_of(frame.camera(view.full.camera)),
            psnr=errors.get(view.name),
        )
        for split, group in (("train", views), ("test", held_out))
        for view in group
    ]
    document = ModelCameras(cameras=cameras).model_dump(mode="json", exclude_none=True)
    (out / "cameras.json").write_text(json.dumps(document, indent=1))
    return written


def spec_of(camera: Camera) -> CameraSpec:
    """The wire's camera for one of the engine."""
    inverse = np.eye(4)
    inverse[:3, :3] = camera.viewmat[:3, :3].T
    inverse[:3, 3] = camera.center
    return CameraSpec.model_validate(
        {
            "camera_to_world": inverse.tolist(),
            "width": camera.width,
            "height": camera.height,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
        }
    )
