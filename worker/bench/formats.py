"""What each file format of models costs: bytes, PSNR and SSIM on held-out photos, seconds to write and to read.

    splatmill bench formats                          # the still life and fox, 3000 steps each: about five minutes
    splatmill bench formats --scenes fox --steps 600
    splatmill bench formats --only levels            # the levels of detail of the same models

Each scene is trained once, at 480 pixels with every 8th photo held out. Its model is written in every format, read
back, and compared with the held-out photos, as the renderer does for downloads. Seconds are CPU seconds of one thread,
since other programs disturb them less.

The levels of a `lod-meta.json` are compared with level 0 as it is seen from near, from the cameras of the held-out
photos. From afar, a picture is 4 and 16 times as small, and the truth in each pixel is the mean of the pixels of the
near picture, which level 0 itself misses, since it aliases there.

Expected before it was measured: .glb without loss; .spz at an eighth of the bytes for 0.2 dB; .compressed.ply at a
fourth for 0.2 dB; .sog at a fourteenth for 0.4 dB, more where few steps leave much noise in the harmonics.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import _page
import torch
from _rows import HERE, Row, distinct, footer
from _studies.study import Study
from _train import scenes
from _train.child import prepared
from _train.run import rounded

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import DOWNLOADS, Event, TrainOptions
from splatmill_worker import pipeline
from splatmill_worker.errors import Refusal
from splatmill_worker.render_service import conversion
from splatmill_worker.render_service.encoding import camera_of
from splatmill_worker.render_service.model_cache import LoadedModel, ModelCache
from splatmill_worker.scene import Camera
from splatmill_worker.splat.evaluate import psnr
from splatmill_worker.splat.formats import registry, streamed_sog
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from splatmill_worker.splat.lod.levels import make_levels
from splatmill_worker.splat.render import render

CACHE = HERE.parent / "build" / "bench"
MODEL = "bench000formats0"
TIMES = (1, 4, 16)
"""How many times as small the pictures of levels are."""


def measured(options: argparse.Namespace) -> Iterator[Row | str]:
    """The rows of the formats of the scenes that were asked for."""
    yield from _of_scenes(options, _formats)


def levels(options: argparse.Namespace) -> Iterator[Row | str]:
    """The rows of the levels of detail of the scenes that were asked for."""
    yield from _of_scenes(options, _levels)


def _of_scenes(
    options: argparse.Namespace, rows: Callable[[Storage, Path], Iterator[Row]]
) -> Iterator[Row | str]:
    for name in options.scenes:
        try:
            scene = scenes.named(name, options.work)
        except (ValueError, FileNotFoundError) as error:
            yield str(error)
            continue
        yield from measure(scene, options.steps, options.work, rows)


def measure(
    scene: scenes.Scene, steps: int, work: Path, rows: Callable[[Storage, Path], Iterator[Row]]
) -> Iterator[Row]:
    """Train a scene and yield the rows of its model, or one that says why there are none."""
    row: Row = {"bench": "formats", "scene": scene.name, "asked_steps": steps}
    ready = prepared(scene, work)
    if "failure" in ready:
        yield row | {"outcome": f"failed: {ready['failure']}"}
        return
    with tempfile.TemporaryDirectory(prefix="splatmill-bench-") as folder:
        workdir = Path(folder)
        (workdir / "sfm").symlink_to((work / scene.name / "sfm").resolve())
        options = TrainOptions.model_validate(scene.options | {"steps": steps, "seed": 0})
        try:
            outcome = pipeline.run(scene.folder, workdir, options, _quiet, lambda: False)
        except Refusal as failure:
            yield row | {"outcome": f"failed: {failure}"}
            return
        storage = _stored(outcome.out, workdir / "storage")
        torch.set_num_threads(1)
        for figures in rows(storage, workdir):
            yield rounded(row | {"outcome": "written"} | figures)


def _formats(storage: Storage, folder: Path) -> Iterator[Row]:
    """A row for each format."""
    for key in DOWNLOADS:
        yield _written(storage, key, folder)


def _levels(storage: Storage, folder: Path) -> Iterator[Row]:
    """A row for each level of detail, down to a sixty-fourth of the Gaussians."""
    model = ModelCache(storage, 0).get(MODEL)
    began = time.process_time()
    made = make_levels(model.gaussians, coarsest=max(1, model.gaussians.count // 60))
    seconds = time.process_time() - began
    index = folder / "levels/lod-meta.json"
    streamed_sog.write_levels(index, made, antialiased=model.antialias)
    cameras = [camera_of(view.camera) for view in conversion.pictures_of(storage, MODEL)[0]]
    for number, level in enumerate(made.levels):
        whole = (
            level.gaussians if made.surroundings is None else concatenate(level.gaussians, made.surroundings)
        )
        yield {
            "format": index.name,
            "level": number,
            "gaussians": level.gaussians.count,
            "surroundings": 0 if made.surroundings is None else made.surroundings.count,
            "bytes": sum(path.stat().st_size for path in index.parent.glob(f"{number}_*/*")),
            "error": sum(level.errors) / len(level.errors),
            "seconds": seconds,
            "pictures": len(cameras),
            "psnr_at": {str(times): _from_afar(model, whole, cameras, times) for times in TIMES},
        }


def _from_afar(model: LoadedModel, gaussians: Gaussians, cameras: list[Camera], times: int) -> float:
    """Mean PSNR, dB, of pictures that are `times` as small, against means over pixels of those of the model."""
    psnrs = []
    for camera in cameras:
        width, height = camera.width // times, camera.height // times
        small = replace(
            camera, width=width, height=height, fx=camera.fx / times, fy=camera.fy / times,
            cx=camera.cx / times, cy=camera.cy / times,
        )  # fmt: skip
        with torch.no_grad():
            near = render(model.gaussians, camera, antialias=model.antialias).color.clamp(0, 1)
            shown = render(gaussians, small, antialias=model.antialias).color.clamp(0, 1)
        near = near[: height * times, : width * times]
        truth = near.reshape(height, times, width, times, 3).mean((1, 3))
        psnrs.append(psnr(float((shown - truth).double().square().mean())))
    return sum(psnrs) / len(psnrs)


def _written(storage: Storage, key: str, folder: Path) -> Row:
    """The row of one format: the model written, read back and compared."""
    model = ModelCache(storage, 0).get(MODEL)
    views, what = conversion.pictures_of(storage, MODEL)
    background = conversion.background_of(storage, MODEL)
    began = time.process_time()
    path, back, record = conversion.convert(model, DOWNLOADS[key], folder)
    both = time.process_time() - began
    began = time.process_time()
    registry.read(path)
    read = time.process_time() - began
    scores = [conversion.score(storage, model, back, view, background) for view in views]
    record = conversion.with_scores(record, scores, what)
    return {
        "format": key,
        "gaussians": record.gaussians,
        "bytes": path.stat().st_size,
        "write_seconds": max(0.0, both - read),
        "read_seconds": read,
        "compared_with": record.compared_with,
        "pictures": record.pictures,
        "psnr": record.psnr,
        "ssim": record.ssim,
        "psnr_before": record.psnr_before,
    }


def _stored(out: Path, folder: Path) -> Storage:
    """A storage that holds the trained model, as the worker publishes it."""
    storage = Storage(str(folder))
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out).as_posix()
        if path.is_file() and layout.model_media_type(name) is not None:
            storage.put(layout.model_file(MODEL, name), path)
    storage.put(layout.job_record(MODEL), b"{}")
    return storage


def _quiet(_: Event) -> None:
    """Ignore an event."""


def table(rows: list[Row]) -> str:
    """The table of each scene and format."""
    rows = [row for row in rows if "level" not in row]
    written = {(row["scene"], row.get("format")): row for row in rows}

    def cell(row: Row) -> list[object]:
        key = row.get("format")
        if key is None:
            return [row["scene"], row["outcome"], *[""] * 8]
        plain, form = written[row["scene"], "ply"], DOWNLOADS[key]
        return [
            f"{row['scene']}, {row['gaussians']:,} Gaussians", f"`{form.suffix}`", f"{row['bytes']:,}",
            f"{plain['bytes'] / row['bytes']:.1f}x", f"{row['psnr']:.2f} dB", f"{plain['psnr'] - row['psnr']:.2f} dB",
            f"{row['ssim']:.3f}", f"{row['write_seconds']:.2f}", f"{row['read_seconds']:.2f}", ", ".join(form.readers),
        ]  # fmt: skip

    head = "scene|format|bytes|smaller|held-out PSNR|loss|SSIM|seconds to write|to read|read by"
    return _page.table(head, map(cell, rows))


def table_of_levels(rows: list[Row]) -> str:
    """The table of each scene and level."""
    rows = [row for row in rows if "level" in row]

    def cell(row: Row) -> list[object]:
        return [
            f"{row['scene']}, {row['surroundings']:,} around it", row["level"], f"{row['gaussians']:,}",
            f"{row['bytes']:,}", f"{row['error']:.4f}", *(_db(row["psnr_at"][str(times)]) for times in TIMES),
        ]  # fmt: skip

    afar = "|".join(f"1/{times} of the size" for times in TIMES[1:])
    return _page.table(f"scene|level|Gaussians|bytes|error, units|from near|{afar}", map(cell, rows))


def _db(value: float) -> str:
    return "-" if value >= 99 else f"{value:.2f} dB"


def made(rows: list[Row]) -> str:
    steps = ", ".join(map(str, distinct(rows, "asked_steps")))
    text = f"Made by `splatmill bench formats` after {steps} steps at 480 pixels; CPU seconds of one thread."
    return f"{text}\n{footer(rows)}"


STUDY = Study(
    name="formats",
    about=__doc__,
    cases={"formats": measured, "levels": levels},
    key=("scene", "format", "level"),
    blocks={"formats": table, "levels": table_of_levels, "footer": made},
    figures={},
    options={
        "scenes": {"nargs": "+", "default": ["synthetic", "fox"]},
        "steps": {"type": int, "default": 3000},
        "work": {"type": Path, "default": CACHE, "help": "where recovered cameras are kept"},
    },
)
main = STUDY.main
