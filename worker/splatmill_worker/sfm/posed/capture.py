"""Captures that bring their cameras: a COLMAP model, nerfstudio or instant-ngp transforms, or a Blender set."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from splatmill_worker.scene import Scene, Source
from splatmill_worker.sfm import stereo
from splatmill_worker.sfm.files import ImageFiles
from splatmill_worker.sfm.posed import colmap_model, transforms
from splatmill_worker.sfm.run import OnProgress

MODEL_FILES = ("cameras.bin", "cameras.txt")
# Where tools put things; the first folder that has a model wins.
MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "0", "")
POSE_FOLDERS = ("poses", "")


@dataclass(frozen=True)
class PosedInput:
    """Cameras found beside the photos; `load` reads them.

    `model`: the folder of a COLMAP model, or None. `transforms`: transforms*.json files. `notes`: what was
    found as well and is not used.
    """

    directory: Path
    source: Source
    model: Path | None
    transforms: tuple[Path, ...]
    notes: tuple[str, ...] = ()

    def load(self) -> Scene:
        """The scene with the cameras as they were given.

        Photos that the cameras name but that are not there are listed in `left_out`, and so are photos
        without a camera. Raises ValueError (with the file and what is wrong) where nothing usable is left.
        """
        files = ImageFiles.under(self.directory)
        if self.model is not None:
            return colmap_model.load(self.model, files, self.notes)
        return transforms.load(self.transforms, self.source, files, self.directory, self.notes)


def completed(
    scene: Scene,
    workdir: Path,
    on_progress: OnProgress = lambda stage, done, total, note: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Scene:
    """The scene with points found over its cameras where it brings few or none; kept in `workdir`.

    What stands on a transparent background is left as it is: its silhouettes say where it can be. Raises what
    `stereo.find` raises.
    """
    if scene.source == "blender" or not stereo.wanted(scene):
        return scene
    stored = workdir / "sfm" / f"posed-{_digest(scene)}.npz"
    return stereo.completed(scene, stored, on_progress, cancelled)


def _digest(scene: Scene) -> str:
    """A name for what the points are found from: the method, the cameras, the known points, and the masks."""
    digest = hashlib.sha256(repr((stereo.VERSION, scene.points.shape)).encode())
    digest.update(scene.points.tobytes())
    for view in scene.views:
        camera = view.camera
        digest.update(repr((view.name, view.lens, view.split, camera.width, camera.height)).encode())
        digest.update(camera.viewmat.tobytes() + camera.K.tobytes())
        if view.mask is not None:
            digest.update(hashlib.sha256(view.mask.read_bytes()).digest())
    return digest.hexdigest()[:24]


def find(directory: Path) -> PosedInput | None:
    """Looks for cameras in `directory` (poses/ first, then the folder itself); None where there are none.

    A COLMAP model wins over transforms.json, since it brings the sparse points as well.
    """
    for base in (directory / folder for folder in POSE_FOLDERS):
        json_files = tuple(sorted(base.glob("transforms*.json"))) if base.is_dir() else ()
        model = _model_under(base)
        if model is not None:
            unused = [path.name for path in json_files]
            notes = (f"The COLMAP model in {model.relative_to(directory)} is used, not {', '.join(unused)}.",)
            return PosedInput(directory, "colmap", model, (), notes if unused else ())
        if json_files:
            plain = tuple(path for path in json_files if path.name == "transforms.json")
            if plain:
                return PosedInput(directory, "transforms", None, plain)
            return PosedInput(directory, "blender", None, json_files)
    return None


def _model_under(base: Path) -> Path | None:
    for folder in MODEL_FOLDERS:
        place = base / folder
        if any((place / name).is_file() for name in MODEL_FILES):
            return place
    return None
