"""Pictures and videos of a model file, without a server: the programs `render-file` and `orbit-file`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np

from splatmill.files import atomic_write, replacing
from splatmill.schema import CameraSpec, ModelCameras, OrbitRequest, RenderRequest
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.film import Film
from splatmill_worker.render_service import leveled_model
from splatmill_worker.render_service.encoding import render_frame, render_image
from splatmill_worker.render_service.model_cache import LoadedModel, antialias_of
from splatmill_worker.splat.formats import registry
from splatmill_worker.splat.formats.contents import Contents
from splatmill_worker.splat.lod.choice import TOLERANCE
from splatmill_worker.splat.orbit import DEFAULT_FOV, Float, orbit_cameras, path_of

UNWRITABLE, REFUSED, STOPPED = 1, 5, 130
"""Exit statuses, those of the command line: a file cannot be read or written; the model cannot be used; Ctrl-C."""

AXES = {
    f"{sign}{name}": (-1.0 if sign else 1.0) * axis
    for sign in ("", "-")
    for name, axis in zip("xyz", np.eye(3), strict=True)
}
"""Directions that may point up in a model without cameras."""

DEFAULT_WIDTH = 640  # pixels, of a picture of a model without cameras; its sides are as 4 to 3

_SAY_EVERY = 2.0  # seconds between two lines about the progress of a video


def main(chosen: argparse.Namespace) -> int:
    """Run `render-file` or `orbit-file` with its parsed arguments; return the exit status."""
    model, out, up = chosen.model, chosen.out, chosen.up
    try:
        if chosen.program == "render-file":
            render_file(model, out, json.loads(chosen.request), chosen.width, up)
        else:
            request = OrbitRequest.model_validate_json(chosen.request)
            orbit_file(model, out, request, chosen.cameras, up)
    except ModelUnreadable as error:
        print(f"Error: {error.message}", file=sys.stderr)
        return REFUSED
    except (OSError, av.FFmpegError) as error:
        print(f"Error: {error.filename or out}: {error.strerror or error}.", file=sys.stderr)
        return UNWRITABLE
    except KeyboardInterrupt:
        print("Stopped; nothing was written.", file=sys.stderr)
        return STOPPED
    print(out)
    return 0


def render_file(model: Path, out: Path, request: dict[str, Any], width: int | None, up: str) -> None:
    """Render an image of the model file `model` and write it to `out`.

    request: the fields of RenderRequest. Without a camera, the image shows the dense middle of the model from the side.
    width: width in pixels of an image without a camera.
    up: the axis that points up in an image without a camera, a key of AXES.

    Raises ModelUnreadable, FileNotFoundError, and OSError where `out` cannot be written.
    """
    with loaded(model) as drawn:
        if "camera" not in request:
            request |= {"camera": overview(drawn, width or DEFAULT_WIDTH, AXES[up])}
        atomic_write(out, render_image(drawn, RenderRequest.model_validate(request)).data)


def orbit_file(model: Path, out: Path, request: OrbitRequest, cameras: Path | None, up: str) -> None:
    """Render a video that circles the model file `model` and write it to `out`.

    cameras: the cameras.json of the model, whose positions the path is fitted to; None gives a circle with `up`.

    Raises ModelUnreadable, FileNotFoundError, and OSError or av.FFmpegError where `out` cannot be written.
    """
    stored = ModelCameras.model_validate_json(cameras.read_bytes()) if cameras is not None else None
    said = time.monotonic()
    with (
        loaded(model) as drawn,
        replacing(out) as part,
        Film(part, request.width, request.height, request.fps) as film,
    ):
        for index, camera in enumerate(orbit_cameras(stored, drawn.gaussians, request, AXES[up])):
            film.add(render_frame(drawn, camera, request.background))
            if time.monotonic() - said > _SAY_EVERY:
                said = time.monotonic()
                print(f"{index + 1} of {request.frames} frames", flush=True)


@contextmanager
def loaded(model: Path) -> Iterator[LoadedModel]:
    """The model in a file of any readable format. One in levels of detail stays open: a view reads what it draws of it.

    Raises ModelUnreadable, and FileNotFoundError.
    """
    with leveled_model.opened(model) as leveled:
        contents = _checked(model, registry.read(model) if leveled is None else leveled.overview)
        reads = None if leveled is None else leveled.seen_by
        yield LoadedModel(str(model), "", contents.gaussians, bool(contents.antialiased), 0, reads=reads)
        if leveled is not None and leveled.tolerance > TOLERANCE:
            print(
                f"{model.name}: memory did not hold all that a view shows, so that coarser levels were drawn, within "
                f"{leveled.tolerance:g} px of their places; {TOLERANCE:g} px are usual.",
                file=sys.stderr,
            )


def read(model: Path) -> Contents:
    """Return what a file of any readable format holds, at least one Gaussian, and whether it was antialiased.

    Where the file does not say so, a report.json beside it does. Its notes are printed. Raises ModelUnreadable, and
    FileNotFoundError.
    """
    return _checked(model, registry.read(model))


def _checked(model: Path, contents: Contents) -> Contents:
    if not contents.gaussians.count:
        raise ModelUnreadable(f"{model.name} has no Gaussians with finite values.")
    for note in contents.notes:
        print(f"{model.name}: {note}", file=sys.stderr)
    if contents.antialiased is not None:
        return contents
    report = model.with_name("report.json")
    return replace(contents, antialiased=antialias_of(report.read_bytes()) if report.is_file() else False)


def overview(model: LoadedModel, width: int, up: Float) -> CameraSpec:
    """Return a camera that shows the dense middle of the model from the side, where an orbit around it begins."""
    path = path_of(model.gaussians, up)
    return CameraSpec.looking_at(
        tuple(path.eye(0.0)),
        tuple(path.target),
        width=width,
        height=max(1, round(width * 3 / 4)),
        fov_y_deg=DEFAULT_FOV,
        up=tuple(path.up),
    )
