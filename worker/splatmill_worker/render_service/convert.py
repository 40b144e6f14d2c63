"""Converts a model file to other formats and says what was lost: the program `convert-file`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from splatmill.schema import ModelCameras, OrbitRequest
from splatmill.schema.files.formats import format_of
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.render_service.encoding import camera_of
from splatmill_worker.render_service.local import REFUSED, STOPPED, UNWRITABLE, read
from splatmill_worker.render_service.loss import Loss, Viewpoint, look, loss
from splatmill_worker.render_service.place import place_beside
from splatmill_worker.render_service.world_up import up_beside
from splatmill_worker.splat.formats import registry
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.orbit import orbit_cameras

MOST_VIEWS = 12
"""Views that are compared at most: they cost about 0.1 s each."""

ORBIT = OrbitRequest.model_validate({"seconds": 0.5, "fps": 16, "width": 640, "height": 480})
"""Eight views around a model without cameras."""


@dataclass(frozen=True)
class Converted:
    """A file that was written.

    gaussians: how many it holds.
    loss: what the model loses in it; None where the format cannot be read back.
    """

    path: Path
    gaussians: int
    loss: Loss | None


def main(model: Path, outs: list[Path], photos: Path | None) -> int:
    """Run from the command line; returns the exit status."""
    try:
        before, converted, notes = convert(model, outs, photos)
    except ModelUnreadable as error:
        print(f"Error: {error.message}", file=sys.stderr)
        return REFUSED
    except OSError as error:
        print(f"Error: {error.filename or model}: {error.strerror or error}.", file=sys.stderr)
        return UNWRITABLE
    except KeyboardInterrupt:
        print("Stopped; what is complete was kept.", file=sys.stderr)
        return STOPPED
    print(table(model, before, converted))
    for note in notes:
        print(note)
    return 0


def convert(model: Path, outs: Sequence[Path], photos: Path | None) -> tuple[int, list[Converted], list[str]]:
    """Write the model in `model` to the files `outs`, whose suffixes tell the formats.

    photos: the folder of the photos in the cameras.json beside the model; None: those in held_out/ beside it, if there.

    Returns the number of Gaussians of the model, the files, and sentences about the comparison. Raises
    ModelUnreadable for a file that cannot be read and for formats that are not written, and OSError.
    """
    for out in outs:
        registry.writer(out)  # before anything is written
    contents = read(model)
    gaussians, antialias = contents.gaussians, bool(contents.antialiased)
    viewpoints, how = _viewpoints(model, gaussians, photos)
    originals, notes = look(gaussians, viewpoints, antialias=antialias)
    converted = []
    for out in outs:
        count = registry.write(
            out,
            gaussians,
            offset=contents.offset,
            antialiased=antialias,
            up=up_beside(model),
            to_earth=place_beside(model),
        )
        lost = None
        model_format = format_of(out.name)
        if model_format is not None and model_format.readable:
            lost = loss(registry.read(out).gaussians, originals, antialias=antialias)
        else:
            notes.append(f"What {out.name} lost is not known: the format is not read.")
        converted.append(Converted(out, count, lost))
    return gaussians.count, converted, [how, *notes]


def table(model: Path, gaussians: int, converted: Sequence[Converted]) -> str:
    """The files with their bytes, and the PSNR of their views against photos and against those of the first file."""
    size = registry.size(model)
    losses = [file.loss for file in converted if file.loss is not None]
    rows = [
        ("file", "bytes", "smaller", "Gaussians", "photos", "views"),
        (
            str(model),
            f"{size:,}",
            "1.0x",
            f"{gaussians:,}",
            _db(losses[0].photos_before if losses else None),
            "-",
        ),
    ]
    for file in converted:
        written, lost = registry.size(file.path), file.loss
        after, views = (lost.photos_after, lost.views) if lost is not None else (None, None)
        ratio = f"{size / max(1, written):.1f}x"
        rows.append((str(file.path), f"{written:,}", ratio, f"{file.gaussians:,}", _db(after), _db(views)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for first, *others in rows:
        cells = [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True)]
        lines.append("  ".join([first.ljust(widths[0]), *cells]))
    return "\n".join(lines)


def _db(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} dB"


def _viewpoints(model: Path, gaussians: Gaussians, photos: Path | None) -> tuple[list[Viewpoint], str]:
    """The cameras to compare from, and a sentence that says which they are."""
    path = model.with_name("cameras.json")
    try:
        stored = ModelCameras.model_validate_json(path.read_bytes()).cameras
        why = "holds none"
    except FileNotFoundError:
        stored, why = [], "does not exist"
    except ValidationError:
        stored, why = [], "is not used: it was not written by Splatmill"
    held_out = [entry for entry in stored if entry.split == "test"]
    chosen = held_out or stored
    if not chosen:
        around = list(orbit_cameras(None, gaussians, ORBIT))
        where = f"{len(around)} synthetic cameras around the scene"
        text = f"views: from {where}, against those of {model.name}; {path} {why}."
        return [Viewpoint(camera) for camera in around], text
    chosen = chosen[:: -(-len(chosen) // MOST_VIEWS)]
    viewpoints = []
    for entry in chosen:
        file, counted = photos / entry.name if photos is not None else None, False
        if photos is None and entry.photo is not None and (path.parent / entry.photo).is_file():
            file, counted = path.parent / entry.photo, True
        viewpoints.append(Viewpoint(camera_of(entry.camera), entry.name, entry.psnr, file, counted))
    what = "held-out" if held_out else "training"
    return viewpoints, (
        f"views: from the cameras of {len(chosen)} {what} photos, against those of {model.name}. "
        "photos: against the photos themselves."
    )
