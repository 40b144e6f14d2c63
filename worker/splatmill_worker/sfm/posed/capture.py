"""Finds the cameras that a capture brings, in the layouts of COLMAP, nerfstudio, instant-ngp and Blender."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from splatmill_worker.images.decoders import mask_fault
from splatmill_worker.scene import Scene, Source
from splatmill_worker.sfm.posed import colmap_model, transforms
from splatmill_worker.sfm.posed.files import ImageFiles

MODEL_FILES = ("cameras.bin", "cameras.txt")
"""Files of which a folder with a COLMAP model has one."""

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "0", "")
"""Folders in which tools put COLMAP models; the first that has one is used."""

POSE_FOLDERS = ("poses", "")
"""Folders of a capture in which cameras are looked for, in order."""


@dataclass(frozen=True)
class PosedInput:
    """Cameras found beside the photos.

    directory: the capture.
    source: the kind of cameras.
    model: folder of the COLMAP model; None for the other kinds.
    transforms: the transforms*.json files; empty for a COLMAP model.
    notes: sentences for the user about files that are not used.
    """

    directory: Path
    source: Source
    model: Path | None
    transforms: tuple[Path, ...]
    notes: tuple[str, ...] = ()

    def load(self) -> Scene:
        """The scene with the cameras as they were given.

        `left_out` of the scene lists cameras whose photo is missing, and photos without a camera. Raises ValueError,
        naming the file and the fault, when no usable view is left, and UnusablePicture for a mask that is too large.
        """
        files = ImageFiles.under(self.directory)
        if self.model is not None:
            scene = colmap_model.load(self.model, files, self.notes)
        else:
            scene = transforms.load(self.transforms, self.source, files, self.directory, self.notes)
        return _without_unfit_masks(scene)


def find(directory: Path) -> PosedInput | None:
    """The cameras in `directory`, in poses/ first; None when there are none.

    A COLMAP model is preferred to transforms.json, because it has sparse points as well.
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


def _without_unfit_masks(scene: Scene) -> Scene:
    """The scene without masks that are unreadable or of another shape than their photo, each named in a note."""
    views, notes = [], []
    for view in scene.views:
        if view.mask is not None:
            fault = mask_fault(view.mask, (view.camera.width, view.camera.height), upright=view.upright)
            if fault is not None:
                notes.append(f"The mask of {view.name} is not used: {fault}.")
                view = replace(view, mask=None)
        views.append(view)
    return replace(scene, views=tuple(views), notes=(*scene.notes, *notes))


def _model_under(base: Path) -> Path | None:
    """The first of MODEL_FOLDERS under `base` with a COLMAP model."""
    for folder in MODEL_FOLDERS:
        place = base / folder
        if any((place / name).is_file() for name in MODEL_FILES):
            return place
    return None
