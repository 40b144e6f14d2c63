"""Finds the cameras that a capture brings, in the layouts of COLMAP, nerfstudio, instant-ngp, Blender and Polycam, or
in files of other programs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from splatmill.data_sets import (
    MODEL_FILES,
    Cameras,
    find_cameras,
    keyframes,
    program_files,
    unread_cameras,
    walk,
)
from splatmill.schema.files.outputs import own_outputs
from splatmill.schema.files.photos import ARCHIVE_SUFFIXES, PHOTO_SUFFIXES, VIDEO_SUFFIXES
from splatmill.schema.quantities import listed
from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images import lens, mask_levels, transparency
from splatmill_worker.images.colors.photo_colors import sentences
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.decoding.decoders import mask_fault, photo_colors
from splatmill_worker.images.examine import too_small
from splatmill_worker.images.masks import unfit
from splatmill_worker.images.panoramas import faces
from splatmill_worker.images.prepare import names_remark
from splatmill_worker.scene import Scene, Source, View, without
from splatmill_worker.sfm.posed import colmap_model, parts, programs, transforms
from splatmill_worker.sfm.posed.files import ImageFiles, none_usable
from splatmill_worker.sfm.posed.programs import ProgramCameras
from splatmill_worker.sfm.posed.same_bytes import without_contradicted
from splatmill_worker.wording import plain

POSE_FOLDERS = ("poses", "")
"""Folders of a capture in which cameras are looked for, in order."""


@dataclass(frozen=True)
class PosedInput:
    """Cameras found beside the photos.

    directory: the capture, or the folder of the data set in it.
    source: the kind of cameras.
    models: folders with a COLMAP model, of which the one with most photos is used; empty for the other kinds.
    transforms: the transforms*.json files; empty for a COLMAP model.
    notes: sentences for the user about files that are not used.
    warnings: sentences for the user about photos that are not used.
    program: the cameras of another program; None for the other kinds.
    archive, unpacked: name of the zip among the photos that has the cameras, and the folder with its content; None
        where they are in no such zip.
    """

    directory: Path
    source: Source
    models: tuple[Path, ...]
    transforms: tuple[Path, ...]
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    program: ProgramCameras | None = None
    archive: str | None = None
    unpacked: Path | None = None

    def load(self) -> Scene:
        """The scene with the cameras as they were given.

        `left_out` of the scene lists cameras whose photo is missing, and photos without a camera. Raises ValueError,
        naming the file and the fault, when no usable view is left, or most have photos of the same bytes,
        UnusablePicture for a mask that is too large, and Refusal where the masks hide all of every photo.
        """
        files = ImageFiles.under(self.directory)
        if self.models:
            scene = colmap_model.load_largest(self.models, files, self.notes)
        elif self.program is not None:
            scene = programs.load(self.program, files, self.notes)
        else:
            around = self.directory if self.unpacked is None else self.unpacked
            scene = transforms.load(self.transforms, self.source, files, around, self.notes)
        scene = without_contradicted(_decoded(_without_unfit_masks(scene)))
        masks = [view.mask for view in scene.views if view.mask is not None]
        unused = {name for name in files.unused_masks if files.masks[name] not in masks}
        judged = mask_levels.judged({view.name: view.mask for view in scene.views}, unused)
        scene = replace(
            scene, views=tuple(replace(view, shown_from=judged.shown_from) for view in scene.views)
        )
        warnings = [
            *judged.warnings,
            *lens.remarks(
                (view.lens for view in scene.views),
                {view.lens for view in scene.views if faces.is_divided(view)},
            ),
            *self._media_beside(files),
        ]
        colors = [photo_colors(view.image, view.name) for view in scene.views]
        return replace(
            scene,
            notes=(*scene.notes, *judged.notes),
            warnings=(*self.warnings, *scene.warnings, *sentences(colors), *warnings),
        )

    def _media_beside(self, files: ImageFiles) -> list[str]:
        """A sentence about videos and zips among the photos; none without them."""
        inside = walk(files.root)
        results = own_outputs(inside)
        names = [
            name
            for name in inside
            if Path(name).suffix.lower() in VIDEO_SUFFIXES + ARCHIVE_SUFFIXES
            and name != self.archive
            and name not in results
        ]
        return [f"Videos and zips are not used where photos have cameras: {listed(names)}."] if names else []


def find(directory: Path, beside: Path | None = None) -> PosedInput | None:
    """The cameras in `directory`, in poses/ first; None when there are none.

    beside: another folder in which the cameras of the photos in `directory` are looked for instead.

    A COLMAP model is preferred to transforms.json, because it has sparse points as well. The cameras may lie some
    folders down: see `splatmill.data_sets.find_cameras`. Those of other programs are used where there are neither.

    Raises TwoDataSets, and TwoFiles.
    """
    bases = [directory / folder for folder in POSE_FOLDERS] if beside is None else [beside]
    for base in bases:
        names = walk(base) if base.is_dir() else []
        cameras = find_cameras(names)
        if cameras is None:
            continue
        place, notes = directory, []
        warnings = tuple(names_remark(directory if beside is None else beside))
        program = programs.find(base, cameras.programs)
        if not cameras.models and not cameras.transforms:
            if program is None:
                continue
            warnings += (*unread_cameras(names), *programs.unrecognised(base, cameras.programs))
            return PosedInput(directory, "program", (), (), (), warnings, program)
        if program is not None:
            preferred = cameras.models[:1] or cameras.transforms[:1]
            own = program.paths[0].name
            warnings += (
                f"The cameras of {program.kind.program} in {own} are not used, but those in {preferred[0]}.",
            )
        if base == directory and cameras.top:
            notes = [f"The cameras are those in {cameras.top}."]
            photos = [name for name in names if Path(name).suffix.lower() in PHOTO_SUFFIXES]
            outside = [name for name in photos if not name.startswith(cameras.top)]
            if len(outside) < len(photos):
                place = directory / cameras.top
                if outside:
                    warnings += (
                        f"Photos outside {cameras.top}, where the cameras are, are not used: {len(outside)}, such as "
                        f"{outside[0]}.",
                    )
        warnings += _unused(names, cameras)
        json_files = tuple(base / name for name in cameras.transforms)
        if cameras.models:
            models = tuple(base / folder for folder in cameras.models)
            return PosedInput(place, "colmap", models, (), tuple(notes), warnings)
        # Without a transforms.json, all files together are the data set.
        alone = any(path.name.lower() == "transforms.json" for path in json_files)
        used = [path for path in json_files if not alone or _belongs(path)]
        others = [path.name for path in json_files if path not in used]
        if others:
            warnings += (f"Not used beside transforms.json: {listed(others)}.",)
        blender = all(parts.of_file(path) is not None for path in used)
        return PosedInput(
            place, "blender" if blender else "transforms", (), tuple(used), tuple(notes), warnings
        )
    return None


def without_cameras(directory: Path) -> list[str]:
    """Sentences about the files with cameras in poses/, of a capture in which `find` finds none that are read."""
    base = directory / POSE_FOLDERS[0]
    names = walk(base) if base.is_dir() else []
    return [*unread_cameras(names), *programs.unrecognised(base, program_files(names))]


def _belongs(path: Path) -> bool:
    """Whether a file is read beside transforms.json: it is that file, or names a part of the data set."""
    return path.name.lower() == "transforms.json" or parts.of_file(path) is not None


def _unused(names: Sequence[str], cameras: Cameras) -> tuple[str, ...]:
    """Warnings about cameras of other kinds in the data set than those that are used."""
    inside = [name for name in names if name.startswith(cameras.top)]
    files = {
        name: folder if keyframes(folder := f"{name.rpartition('/')[0]}/") else name
        for name in inside
        if name in cameras.transforms or keyframes(f"{name.rpartition('/')[0]}/")
    }
    used = cameras.models[:1] or tuple(files[name] for name in cameras.transforms[:1])
    kept = () if cameras.models else cameras.transforms
    others = sorted({files[name] for name in files if name not in kept} - set(used))
    warnings = []
    if others:
        warnings.append(f"The cameras in {used[0]} are used, not those in {listed(others)}.")
    lower = {name.lower() for name in inside}
    warnings += [
        f"{folder} has its model as .bin and as .txt; the .bin files are used."
        for folder in cameras.models
        if {f"{folder}{name}".lower() for name in MODEL_FILES} <= lower
    ]
    return tuple(warnings)


def _decoded(scene: Scene) -> Scene:
    """The scene without photos that do not decode, are too small or wholly transparent, and a warning about opaque ones
    among cut-outs."""
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        alphas = list(pool.map(_alpha, scene.views))
    broken = [
        (view.name, alpha) for view, alpha in zip(scene.views, alphas, strict=True) if isinstance(alpha, str)
    ]
    if broken and len(broken) == len(scene.views):
        raise none_usable(broken)
    whole = {
        view.name: alpha
        for view, alpha in zip(scene.views, alphas, strict=True)
        if not isinstance(alpha, str)
    }
    for name, reason in broken:
        scene = without(scene, [i for i, view in enumerate(scene.views) if view.name == name], reason)
    clear = [index for index, view in enumerate(scene.views) if transparency.is_clear(whole[view.name])]
    if clear and len(clear) == len(scene.views):
        raise ValueError(
            f"All {len(clear)} photos with a camera are wholly transparent, so they show nothing."
        )
    scene = without(scene, clear, transparency.NOTHING)
    said = transparency.remarks({view.name: whole[view.name] for view in scene.views})
    return replace(scene, warnings=(*scene.warnings, *said))


def _alpha(view: View) -> transparency.Extent | str:
    """The extent of a photo, or why it cannot be used."""
    try:
        return too_small(view.camera.width, view.camera.height) or decoders.alpha(view.image)
    except UnusablePicture as error:
        return error.reason
    except OSError as error:
        return f"it cannot be read: {plain(error)}"


def _without_unfit_masks(scene: Scene) -> Scene:
    """The scene without masks that are unreadable or of another shape than their photo, with a warning."""
    views, faults = [], []
    for view in scene.views:
        if view.mask is not None:
            fault = mask_fault(view.mask, (view.camera.width, view.camera.height), upright=view.upright)
            if fault is not None:
                faults.append((view.name, fault))
                view = replace(view, mask=None)
        views.append(view)
    return replace(scene, views=tuple(views), warnings=(*scene.warnings, *unfit(faults)))
