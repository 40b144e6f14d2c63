"""Meshes of a model file, without a server: the program `mesh-file`; and the cameras that a mesh is made from."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from pydantic import ValidationError

from splatmill.backplane.rendering import MeshLine
from splatmill.backplane.storage.records import reason
from splatmill.process import die_with_parent
from splatmill.schema import Box, MeshFacts, ModelCameras, OrbitRequest, Progress
from splatmill_worker.errors import ModelUnreadable, Refusal
from splatmill_worker.kernels import ops
from splatmill_worker.mesh import glb, ply
from splatmill_worker.mesh.build import Built, MeshSettings, NoSurface, Told, build
from splatmill_worker.mesh.poisson import TooFine
from splatmill_worker.mesh.triangles import Mesh
from splatmill_worker.render_service.encoding import camera_of
from splatmill_worker.render_service.local import AXES, REFUSED, STOPPED, UNWRITABLE, read
from splatmill_worker.render_service.world_up import up_of
from splatmill_worker.sandbox import FIRST_TO_DIE
from splatmill_worker.scene import Camera
from splatmill_worker.splat.formats.gltf import Up
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.orbit import DEFAULT_FOV, UP, Float, cameras_along, path_of

RINGS = (-0.2, 0.35, 1.1)
"""Heights of the rings of cameras around a model without cameras, in radii of the lowest."""

RING = OrbitRequest(seconds=1.0, fps=24, width=800, height=600)
"""The cameras of one ring: their number and size."""

NICE = 10
"""By how much the process of a renderer is nicer than that: views that people wait for come first."""

SAY_EVERY = 2.0  # seconds between two lines about the progress


def main(chosen: argparse.Namespace) -> int:
    """Run `mesh-file` with its parsed arguments; return the exit status."""
    if chosen.parent is not None:
        _serve(chosen.parent)
    told = _sent if chosen.parent is not None else _Lines().told
    box = None if chosen.box is None else Box.model_validate_json(chosen.box)
    settings = MeshSettings(
        chosen.faces, chosen.voxel, None if box is None else (box.min, box.max), chosen.texture
    )
    try:
        built = mesh_file(chosen.model, chosen.out, settings, chosen.cameras, chosen.up, chosen.backend, told)
    except (ModelUnreadable, Refusal) as error:
        if chosen.parent is not None:
            print(MeshLine(problem=error.problem()).encoded().decode(), end="", flush=True)
        else:
            print(f"Error: {error.message}", file=sys.stderr)
        return REFUSED
    except OSError as error:
        print(f"Error: {error.filename or chosen.out}: {error.strerror or error}.", file=sys.stderr)
        return UNWRITABLE
    except KeyboardInterrupt:
        print("Stopped; nothing was written.", file=sys.stderr)
        return STOPPED
    if chosen.parent is not None:
        print(MeshLine(facts=facts_of(built)).encoded().decode(), end="", flush=True)
        return 0
    mesh = built.mesh
    print(
        f"{len(mesh.faces):,} triangles and {len(mesh.vertices):,} vertices from {built.views} views; voxels of "
        f"{built.voxel:.4g}, {built.extracted:,} triangles before simplification."
    )
    print(chosen.out)
    return 0


def mesh_file(
    model: Path,
    out: Path,
    settings: MeshSettings,
    cameras: Path | None,
    up: str,
    backend: ops.Backend | None,
    told: Told,
) -> Built:
    """Write the mesh of the model file `model` to `out`, a `.glb` or a `.ply`.

    cameras: a cameras.json; None takes the one beside the model or, where there is none, rings of cameras around it.
    up: the axis that points up in a model without cameras, a key of AXES.

    Raises ModelUnreadable, Refusal where the cameras cannot be used or nothing is found, and OSError.
    """
    contents = read(model)
    path = cameras or model.with_name("cameras.json")
    stored = _stored(path) if cameras is not None or path.is_file() else None
    gaussians = (
        contents.gaussians.map(lambda tensor: tensor.cuda()) if backend == "gpu" else contents.gaussians
    )
    every = cameras_for(stored, gaussians, AXES[up])
    try:
        built = build(
            gaussians, every, settings, antialias=bool(contents.antialiased), backend=backend, told=told
        )
    except NoSurface as error:
        raise Refusal(
            "option_out_of_range",
            "No two cameras agree on a surface of this model. Check that the cameras are those of the model, and that "
            "the box holds a part of it.",
        ) from error
    except TooFine as error:
        raise Refusal("option_out_of_range", f"{error} Choose larger voxels or a smaller box.") from error
    set_up = stored is None or len(stored.cameras) < 2
    x, y, z = (float(value) for value in AXES[up])
    write(out, built.mesh, contents.offset, (x, y, z) if set_up else up_of(stored))
    return built


def facts_of(built: Built) -> MeshFacts:
    """What a mesh is made of, as the API says it."""
    mesh = built.mesh
    return MeshFacts(
        triangles=len(mesh.faces), vertices=len(mesh.vertices), views=built.views, voxel=built.voxel
    )


def cameras_for(stored: ModelCameras | None, gaussians: Gaussians, up: Float = UP) -> list[Camera]:
    """The cameras of the model's photos; where there are fewer than two, rings of cameras around its dense middle."""
    if stored is not None and len(stored.cameras) > 1:
        return [camera_of(row.camera) for row in stored.cameras]
    return list(_rings(gaussians, up))


def write(out: Path, mesh: Mesh, offset: tuple[float, float, float], up: Up | None = None) -> None:
    """Write a mesh in the format of the suffix. offset: world = model + offset. up: by which a `.glb` is upright."""
    if out.suffix.lower() == ".glb":
        glb.write(out, mesh, offset, up)
        return
    comments = ["Made by Splatmill"]
    if any(offset):
        comments.append("offset " + " ".join(f"{value:.0f}" for value in offset))
    ply.write(out, mesh.vertices, mesh.faces, mesh.colors, tuple(comments))


def _rings(gaussians: Gaussians, up: Float) -> Iterable[Camera]:
    path = path_of(gaussians, up)
    for height in RINGS:
        shape = replace(
            path, height=height * path.radius, radius=path.radius / math.sqrt(1.0 + max(0.0, height) ** 2)
        )
        yield from cameras_along(shape, RING, DEFAULT_FOV)


def _stored(path: Path) -> ModelCameras:
    try:
        return ModelCameras.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise Refusal(
            "poses_invalid",
            f"{path} is not the cameras.json of a model: {reason(error)}. Download it with the model.",
        ) from error


def _serve(parent: int) -> None:
    """Make this process one that a renderer needs least: it ends with it, yields to it, and dies first."""
    die_with_parent(parent)
    os.nice(NICE)
    with suppress(OSError):  # not on every system
        Path("/proc/self/oom_score_adj").write_text(FIRST_TO_DIE)


def _sent(progress: Progress) -> None:
    print(MeshLine(progress=progress).encoded().decode(), end="", flush=True)


class _Lines:
    """Prints what is being done, a line every SAY_EVERY seconds."""

    def __init__(self) -> None:
        self._said = time.monotonic()

    def told(self, progress: Progress) -> None:
        if time.monotonic() - self._said > SAY_EVERY:
            self._said = time.monotonic()
            count = f": {progress.done} of {progress.total}" if progress.total else ""
            print(f"{progress.stage}{count}", flush=True)
