"""The trained scene as files, in the world that the cameras came in."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from splatmill.files import atomic_write
from splatmill.schema import CameraSpec, ModelCamera, ModelCameras, ModelFrame
from splatmill_worker.scene import Camera, Normalization, Scene
from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.report.held_out import write_held_out
from splatmill_worker.splat.train.loop import Trained
from splatmill_worker.splat.train.renderer import evaluation_background
from splatmill_worker.splat.views import TrainingView

FAR = 1e4
"""Distance of the cameras from the origin, in radii of the cameras, from which float32 coordinates would lose what
photos resolve."""


@dataclass(frozen=True)
class ExportWorld:
    """The world of the exported files, and how to get there from the training world.

    A point is exported at (p - translation) / scale - offset, with `translation` and `scale` of the normalization.

    normalization: from the world that the cameras came in to the training world.
    offset: [3], added to an exported point to get to the world that the cameras came in. Zero except for scenes far
        from their origin (geo-referenced ones).
    frame: how the world that the cameras came in was chosen; None where it was given.
    """

    normalization: Normalization
    offset: npt.NDArray[np.float64]
    frame: ModelFrame | None = None

    @staticmethod
    def of(normalization: Normalization, scene: Scene) -> ExportWorld:
        """The world of `scene`, or one that is moved near the cameras where float32 could not hold that."""
        middle = scene.centers.mean(axis=0)
        far = float(np.linalg.norm(middle)) * normalization.scale > FAR
        return ExportWorld(normalization, np.round(middle) if far else np.zeros(3), scene.frame)

    @property
    def up(self) -> tuple[float, float, float] | None:
        """What points up in a frame that was chosen, in which y points down and the origin is what the cameras look at.

        None for other worlds, of which neither is known.
        """
        return None if self.frame is None or self.offset.any() else (0.0, -1.0, 0.0)

    def camera(self, camera: Camera) -> Camera:
        """A camera of the training world in this world."""
        original = self.normalization.undo_camera(camera)
        return original.moved_to(original.center - self.offset)

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians of the training world in this world."""
        scale = 1.0 / self.normalization.scale
        shift = -scale * self.normalization.translation - self.offset
        return gaussians.moved(scale, torch.from_numpy(shift))


@dataclass(frozen=True)
class Exported:
    """The files that `export` wrote.

    gaussians: how many model.ply holds.
    world: the world of model.ply and cameras.json.
    left_out: held-out photos that were not written, each with the reason.
    """

    gaussians: int
    world: ExportWorld
    left_out: Sequence[tuple[str, str]] = ()


def export(
    out: Path, trained: Trained, plan: Plan, world: ExportWorld, held_out: Sequence[TrainingView]
) -> Exported:
    """Write model.ply, cameras.json, frame.json if there is a frame, and the held-out photos into the folder `out`."""
    x, y, z = world.offset
    written = ply.write(
        out / "model.ply",
        world.gaussians(trained.gaussians),
        offset=(float(x), float(y), float(z)),
        antialiased=plan.antialias,
        degree=plan.schedule.degree,
        comments=("Made by Splatmill",),
    )
    photos, left_out = write_held_out(out, held_out, evaluation_background(plan, trained.views))
    scores = {} if trained.held_out is None else {view.name: view for view in trained.held_out.views}
    cameras = [
        ModelCamera(
            name=view.name,
            split=split,
            camera=spec_of(world.camera(view.full.camera)),
            psnr=None if score is None else score.psnr,
            psnr_color_fitted=None if score is None else score.psnr_color_fitted,
            ssim=None if score is None else score.ssim,
            photo=photos.get(view.name),
        )
        for split, views in (("train", trained.views), ("test", held_out))
        for view in views
        for score in [scores.get(view.name)]
    ]
    document = ModelCameras(cameras=cameras, up=world.up).model_dump(mode="json", exclude_none=True)
    atomic_write(out / "cameras.json", json.dumps(document, indent=1))
    if world.frame is not None:
        atomic_write(out / "frame.json", world.frame.model_dump_json(indent=1))
    return Exported(written, world, left_out)


def spec_of(camera: Camera) -> CameraSpec:
    """The wire's description of a camera."""
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
