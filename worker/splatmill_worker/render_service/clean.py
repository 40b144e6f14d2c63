"""Cleans a model file by a box, by weight, and by what its photos say: the program `clean-file`."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from pydantic import ValidationError
from torch import Tensor

from splatmill.backplane.storage.records import reason
from splatmill.data_sets import TwoDataSets
from splatmill.schema import EditModel, ModelCameras
from splatmill_worker.errors import ModelUnreadable, Refusal, StartUnusable
from splatmill_worker.images.archives.archive import UnsafeArchive, unpack
from splatmill_worker.images.load import load_views
from splatmill_worker.render_service.edit import kept
from splatmill_worker.render_service.encoding import camera_of
from splatmill_worker.render_service.local import REFUSED, STOPPED, UNWRITABLE, read
from splatmill_worker.render_service.place import place_beside
from splatmill_worker.render_service.world_up import up_beside
from splatmill_worker.scene import Normalization, Scene, View, split
from splatmill_worker.sfm import posed
from splatmill_worker.splat.cleaning import clean, photo_psnr
from splatmill_worker.splat.evaluate import benchmark_background
from splatmill_worker.splat.evidence import evidence_of
from splatmill_worker.splat.formats import registry
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.start.given_model import assess
from splatmill_worker.splat.views import Target, TrainingView

DEFAULT_SIDE = 960
"""Longest side of the photos in pixels, of a model without cameras.json. With one, that of its cameras."""


@dataclass(frozen=True)
class CleanSettings:
    """What to clean by; None: not by that.

    capture: folder of the photos, with their cameras or for the cameras.zip beside the model.
    edit: a box outside of which Gaussians are removed.
    min_weight: weight in pixels, in the photo where it is largest, below which a Gaussian is removed.
    image_size: longest side of the photos, pixels; None: as DEFAULT_SIDE says.
    """

    capture: Path | None = None
    edit: EditModel | None = None
    min_weight: float | None = None
    image_size: int | None = None


@dataclass
class Cleaned:
    """What was removed, and what that did.

    before: number of Gaussians of the model.
    left: how many of them stay.
    removed: number for each condition and reason that was applied, zero included, in the order of the table.
    photos, held_out: number of training photos and of held-out ones, mean PSNR before and after in dB; None without.
    """

    before: int
    left: int
    removed: dict[str, int] = field(default_factory=dict)
    photos: tuple[int, float, float] | None = None
    held_out: tuple[int, float, float] | None = None


@dataclass(frozen=True)
class _Views:
    """Photos of the model, or only their cameras, in a world at which float32 is accurate.

    frame: the similarity to that world from the one of the cameras.
    offset: [3], added to the model to get to the world of the cameras.
    training, held_out: the photos; without `photos`, their pixels are black.
    photos: whether there are pixels.
    """

    frame: Normalization
    offset: tuple[float, float, float]
    training: list[TrainingView]
    held_out: list[TrainingView]
    photos: bool


def run(chosen: argparse.Namespace) -> int:
    """Run `clean-file` with its parsed arguments; returns the exit status."""
    edit = None if chosen.edit is None else EditModel.model_validate_json(chosen.edit)
    settings = CleanSettings(chosen.capture, edit, chosen.min_weight, chosen.image_size)
    return main(chosen.model, chosen.out, settings)


def main(model: Path, out: Path, settings: CleanSettings) -> int:
    """Clean a file, print what was removed, and return the exit status."""
    try:
        cleaned = clean_file(model, out, settings)
    except (ModelUnreadable, Refusal) as error:
        print(f"Error: {error.message}", file=sys.stderr)
        return REFUSED
    except OSError as error:
        print(f"Error: {error.filename or out}: {error.strerror or error}.", file=sys.stderr)
        return UNWRITABLE
    except KeyboardInterrupt:
        print("Stopped; nothing was written.", file=sys.stderr)
        return STOPPED
    print(table(cleaned))
    print(out)
    return 0


def clean_file(model: Path, out: Path, settings: CleanSettings) -> Cleaned:
    """Write what cleaning leaves of the model in `model` to `out`, whose suffix names the format.

    Photos that cameras.json beside the model names as held out decide nothing; without a cameras.json, they are chosen
    as for a training. Raises ModelUnreadable, Refusal where the photos or cameras cannot be used or nothing would be
    left, and OSError.
    """
    registry.writer(out)  # before anything is measured
    contents = read(model)
    whole, antialias = contents.gaussians, bool(contents.antialiased)
    cleaned = Cleaned(whole.count, whole.count)
    keep = torch.ones(whole.count, dtype=torch.bool)
    if settings.edit is not None:
        keep = kept(whole, settings.edit)
        cleaned.removed["outside the box"] = int((~keep).sum())
    if (settings.min_weight is not None or settings.capture is not None) and bool(keep.any()):
        views = _views(model, settings, contents.offset)
        shift = views.frame.scale * torch.tensor(views.offset, dtype=torch.float64)
        shift += torch.from_numpy(views.frame.translation)
        keep = _by_photos(whole.moved(views.frame.scale, shift), keep, views, settings, antialias, cleaned)
    if not bool(keep.any()):
        raise Refusal(
            "option_out_of_range",
            f"Nothing would be left of the {whole.count:,} Gaussians. Choose a larger box or a smaller weight.",
        )
    cleaned.left = registry.write(
        out,
        whole.select(keep),
        offset=contents.offset,
        antialiased=antialias,
        up=up_beside(model),
        to_earth=place_beside(model),
    )
    return cleaned


def table(cleaned: Cleaned) -> str:
    """What was removed by reason, and the PSNR before and after."""
    rows = [("removed", "Gaussians", "share")]
    for kind, count in (*cleaned.removed.items(), ("left", cleaned.left)):
        rows.append((kind, f"{count:,}", f"{100.0 * count / cleaned.before:.2f} %"))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        f"{first.ljust(widths[0])}  {count.rjust(widths[1])}  {share.rjust(widths[2])}"
        for first, count, share in rows
    ]
    for name, scores in (("training", cleaned.photos), ("held-out", cleaned.held_out)):
        if scores is not None:
            number, before, after = scores
            plural = "" if number == 1 else "s"
            lines.append(
                f"PSNR on {number} {name} photo{plural}: {before:.2f} dB before, {after:.2f} dB after."
            )
    return "\n".join(lines)


def _by_photos(
    gaussians: Gaussians,
    keep: Tensor,
    views: _Views,
    settings: CleanSettings,
    antialias: bool,
    cleaned: Cleaned,
) -> Tensor:
    """The Gaussians that stay, bool [N], of those in `keep`; what goes is entered in `cleaned`."""
    targets = [view.full for view in views.training]
    background = benchmark_background(views.training)
    if views.photos:
        _check_world(gaussians.select(keep), views.training, antialias)
    before = [_mean(gaussians, each, background, antialias) for each in (views.training, views.held_out)]
    if settings.min_weight is not None:
        rows = keep.nonzero()[:, 0]
        weights = evidence_of(gaussians.select(rows), targets, background, antialias=antialias).peak
        light = rows[weights < settings.min_weight]
        keep[light] = False
        cleaned.removed[f"weight below {settings.min_weight:g}"] = len(light)
    if not views.photos:
        return keep
    if settings.capture is not None and bool(keep.any()):
        rows = keep.nonzero()[:, 0]
        cleaning = clean(gaussians.select(rows), targets, background, antialias=antialias)
        keep[rows[~cleaning.keep]] = False
        cleaned.removed |= {f"unsupported: {kind}": count for kind, count in cleaning.removed.items()}
    left = gaussians.select(keep)
    after = [_mean(left, each, background, antialias) for each in (views.training, views.held_out)]
    cleaned.photos = (len(views.training), before[0], after[0])
    if views.held_out:
        cleaned.held_out = (len(views.held_out), before[1], after[1])
    return keep


def _mean(gaussians: Gaussians, views: Sequence[TrainingView], background: Tensor, antialias: bool) -> float:
    """Mean PSNR over the photos, dB; 0 of none."""
    scores = [photo_psnr(gaussians, view.full, background, antialias) for view in views]
    return sum(scores) / max(1, len(scores))


def _check_world(gaussians: Gaussians, views: Sequence[TrainingView], antialias: bool) -> None:
    """Raise Refusal for a model that lies in another world than the cameras: all of it would be unsupported."""
    try:
        assess(gaussians, views, antialiased=antialias)
    except StartUnusable as error:
        raise Refusal(
            "poses_invalid",
            f"{error.message} Give the photos and cameras that it was trained on.",
        ) from error


def _views(model: Path, settings: CleanSettings, offset: tuple[float, float, float]) -> _Views:
    """The photos in the capture, or the cameras in the cameras.json beside the model where there is no capture."""
    stored = _stored(model)
    if settings.capture is None:
        if stored is None:
            raise Refusal(
                "poses_invalid",
                f"A weight is measured from cameras, and there is no cameras.json beside {model.name}. "
                "Give the photos and their cameras with --capture.",
            )
        return _cameras_alone(stored)
    with ExitStack() as stack:
        scene, own = _scene(settings.capture, model, stack)
        training, held_out = _split(scene, stored)
        side = settings.image_size or (DEFAULT_SIDE if stored is None else _longest(stored))
        frame = Normalization.of(scene)
        shown, set_aside = (
            [TrainingView.of(photo, frame) for photo in load_views(views, side)]
            for views in (training, held_out)
        )
        return _Views(frame, (0.0, 0.0, 0.0) if own else offset, shown, set_aside, photos=True)


def _scene(capture: Path, model: Path, stack: ExitStack) -> tuple[Scene, bool]:
    """The posed scene of a capture, and whether its cameras are those of the model, in the world of its file."""
    try:
        cameras, own = posed.find(capture), False
    except (TwoDataSets, posed.TwoFiles) as error:
        raise Refusal("poses_invalid", str(error)) from error
    beside = model.with_name("cameras.zip")
    if cameras is None and beside.is_file():
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="splatmill-clean-")))
        images = capture / "images"
        (folder / "images").symlink_to((images if images.is_dir() else capture).resolve())
        try:
            unpack(beside, folder / "poses")
        except UnsafeArchive as error:
            raise Refusal("poses_invalid", f"{beside} is damaged: {error}.") from error
        cameras, own = posed.find(folder), True
    if cameras is None:
        raise Refusal(
            "poses_invalid",
            f"{capture} has no cameras (a COLMAP model, transforms.json or a Blender data set), and there is no "
            f"cameras.zip beside {model.name}.",
        )
    try:
        return cameras.load(), own
    except ValueError as error:
        raise Refusal("poses_invalid", str(error)) from error


def _split(scene: Scene, stored: ModelCameras | None) -> tuple[Sequence[View], Sequence[View]]:
    """Training views and held-out ones: as the model's cameras.json says, or else as for a training."""
    held = {row.name for row in stored.cameras if row.split == "test"} if stored is not None else set()
    if not held:
        return split(scene)
    views = [replace(view, split="test" if view.name in held else "train") for view in scene.views]
    return [v for v in views if v.split == "train"], [v for v in views if v.split == "test"]


def _stored(model: Path) -> ModelCameras | None:
    """The cameras.json beside a model; None where there is none. Raises Refusal for one that cannot be read."""
    path = model.with_name("cameras.json")
    try:
        return ModelCameras.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except ValidationError as error:
        raise Refusal(
            "poses_invalid",
            f"{path} is damaged: {reason(error)}. It names the photos that were held out. Download it again, or move "
            "it away to hold out every eighth photo.",
        ) from error


def _longest(stored: ModelCameras) -> int:
    return max(max(row.camera.width, row.camera.height) for row in stored.cameras)


def _cameras_alone(stored: ModelCameras) -> _Views:
    """The training cameras of a model as views of black photos, in the world of its file."""
    cameras = [camera_of(row.camera) for row in stored.cameras if row.split != "test"]
    scene = Scene(
        tuple(View(str(index), camera, Path()) for index, camera in enumerate(cameras)),
        torch.zeros(0, 3, dtype=torch.float64).numpy(),
        torch.zeros(0, 3, dtype=torch.uint8).numpy(),
        "colmap",
    )
    frame = Normalization.of(scene)
    views = []
    for view in scene.views:
        camera = frame.camera(view.camera)
        black = torch.zeros(camera.height, camera.width, 3, dtype=torch.uint8)
        views.append(TrainingView(view.name, {1: Target.of(camera, black)}))
    return _Views(frame, (0.0, 0.0, 0.0), views, [], photos=False)
