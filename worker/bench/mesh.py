"""How true a mesh of the still life is: Chamfer distance and F-scores against its exact surface, seconds and bytes.

    splatmill bench mesh                     # 40 photos, 3000 steps: about ten minutes
    splatmill bench mesh --model out/model.ply

The still life is trained from its true cameras, so that nothing has to be aligned. Beside Splatmill's mesh stand
COLMAP's Poisson reconstruction of the sparse points, and Open3D's fusion of the same depths where it is installed.
Seconds are CPU seconds of all threads, after the training.

Expected before it was measured: an F-score of 0.95 at 1 % of the scene's size for the depths; fused ones as true, with
more holes; Poisson of the sparse points below 0.7.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import _page
import torch
from _mesh import others, truth
from _rows import HERE, Row, footer
from _studies.study import Study
from _train import bare

from splatmill.schema import Event, ModelCameras, TrainOptions
from splatmill_worker import pipeline
from splatmill_worker.mesh.build import MeshSettings, build
from splatmill_worker.mesh.colors import colored
from splatmill_worker.mesh.depths import View
from splatmill_worker.mesh.samples import Region
from splatmill_worker.mesh.triangles import Mesh, simplified
from splatmill_worker.render_service.local import read
from splatmill_worker.render_service.mesh import cameras_for, write
from splatmill_worker.synthetic import still_life
from splatmill_worker.synthetic.ray_caster import StillLife

CACHE = HERE.parent / "build" / "bench" / "mesh"
FACES = (500_000, 100_000)
"""Most triangles of Splatmill's meshes; the seconds of the second one are those after the first."""

PIXEL = 0.007
"""Width of a pixel at the median depth, world units: the voxels of the fusion."""

BOX = ((-1.95, -1.95, -0.1), (1.95, 1.95, 1.3))
"""The part of the world that is built: the table and what stands on it, without the floor."""


def measured(options: argparse.Namespace) -> Iterator[Row | str]:
    """The rows of every method."""
    model = options.model or trained(options.steps, options.work)
    report = json.loads(model.with_name("report.json").read_text())
    contents = read(model)
    stored = ModelCameras.model_validate_json(model.with_name("cameras.json").read_bytes())
    cameras = cameras_for(stored, contents.gaussians)
    life = still_life(0)
    true = truth.visible(life, cameras)
    antialias = bool(contents.antialiased)
    same: Row = {
        "bench": "mesh",
        "steps": report["result"]["steps"],
        "gaussians": contents.gaussians.count,
        "psnr": report["result"]["psnr"],
    }
    views: list[View] = []
    began = time.process_time()
    built = build(
        contents.gaussians, cameras, MeshSettings(FACES[0], box=BOX), antialias=antialias, views=views
    )
    yield same | row(f"Splatmill, {FACES[0]:,} triangles at most", built.mesh, began, true, life)
    near = [_in_box(view) for view in views]
    methods: dict[str, Callable[[], Mesh]] = {
        "COLMAP's Poisson of the sparse points": lambda: others.of_sparse_points(
            model.with_name("cameras.zip")
        ),
        "Open3D's fusion of the same depths": lambda: others.by_open3d(near, PIXEL, 2 * built.middle),
    }
    methods[f"Splatmill, {FACES[1]:,} triangles at most"] = lambda: colored(
        simplified(built.mesh, FACES[1]), views
    )
    for name, made in methods.items():
        began = time.process_time()
        try:
            mesh = made()
        except others.Missing as error:
            yield same | {"method": name, "outcome": f"left out: {error}"}
            continue
        yield same | row(name, mesh, began, true, life)


def _in_box(view: View) -> View:
    """The view without depths outside the box."""
    numbers = view.points()[1]
    inside = Region(math.inf, BOX).of(view)
    depth = torch.zeros_like(view.depth)
    depth.view(-1)[numbers[inside]] = view.depth.reshape(-1)[numbers[inside]]
    return replace(view, depth=depth)


def row(name: str, mesh: Mesh, began: float, true: truth.Float, life: StillLife) -> Row:
    """What is measured of one mesh."""
    seconds = time.process_time() - began
    with tempfile.TemporaryDirectory(prefix="splatmill-bench-") as folder:
        path = Path(folder) / "mesh.glb"
        write(path, mesh, (0.0, 0.0, 0.0))
        size = path.stat().st_size
    shape = {"faces": len(mesh.faces), "bytes": size, "cpu_seconds": round(seconds, 1)}
    scores = {key: round(value, 5) for key, value in truth.scores(mesh, true, life).items()}
    return {"method": name, "outcome": "measured"} | shape | scores


def trained(steps: int, work: Path) -> Path:
    """The model.ply of the still life after so many steps; it is kept for the next time."""
    capture, workdir = work / "capture", work / f"{steps}steps"
    if not capture.is_dir():
        work.mkdir(parents=True, exist_ok=True)
        bare.make("synthetic-posed", capture, 40)
    if not (workdir / "out" / "report.json").is_file():
        workdir.mkdir(parents=True, exist_ok=True)
        options = TrainOptions.model_validate({"steps": steps, "seed": 0, "image_size": 640})
        pipeline.run(capture, workdir, options, _quiet, lambda: False)
    return workdir / "out" / "model.ply"


def _quiet(_: Event) -> None:
    """Ignore an event."""


def table(rows: list[Row]) -> str:
    """A row for each mesh."""

    def cell(row: Row) -> list[object]:
        if row["outcome"] != "measured":
            return [row["method"], row["outcome"], *[""] * 8]
        scores = [f"{row[f'f_{share:g}']:.3f}" for share in truth.SHARES]
        return [
            row["method"], f"{row['faces']:,}", f"{row['bytes'] / 1e6:.1f}", f"{row['cpu_seconds']:.0f}",
            f"{row['chamfer']:.4f}", *scores, f"{row['precision_0.01']:.3f}", f"{row['completeness_0.01']:.3f}",
        ]  # fmt: skip

    at = "|".join(f"F at {share:.2%}" for share in truth.SHARES)
    head = f"mesh|triangles|MB|CPU seconds|Chamfer|{at}|precision at 1 %|completeness at 1 %"
    return _page.table(head, map(cell, rows))


def made(rows: list[Row]) -> str:
    first = rows[0]
    text = (
        f"Made by `splatmill bench mesh` from {first['gaussians']:,} Gaussians after {first['steps']} steps "
        f"({first['psnr']:.2f} dB on held-out photos)."
    )
    return f"{text}\n{footer(rows)}"


STUDY = Study(
    name="mesh",
    about=__doc__,
    cases={"mesh": measured},
    key=("method",),
    blocks={"mesh": table, "footer": made},
    figures={},
    options={
        "steps": {"type": int, "default": 3000},
        "model": {"type": Path, "help": "a model of the still life's true cameras, in place of training one"},
        "work": {"type": Path, "default": CACHE, "help": "where capture and model are kept"},
    },
)
main = STUDY.main
