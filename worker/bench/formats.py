"""What each file format of models costs: bytes, PSNR and SSIM on held-out photos, seconds to write and to read.

    splatmill bench formats                          # the still life and fox, 3000 steps each: about five minutes
    splatmill bench formats --scenes fox --steps 600

Each scene is trained once, at 480 pixels with every 8th photo held out. Its model is written in every format, read
back, and compared with the held-out photos, as the renderer does for downloads. Seconds are CPU seconds of one thread,
since other programs disturb them less.

Expected before it was measured: .glb without loss; .spz at an eighth of the bytes for 0.2 dB; .compressed.ply at a
fourth for 0.2 dB; .sog at a fourteenth for 0.4 dB, more where few steps leave much noise in the harmonics.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
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
from splatmill_worker.render_service.model_cache import ModelCache
from splatmill_worker.splat.formats import registry

CACHE = HERE.parent / "build" / "bench"
MODEL = "bench000formats0"


def measured(options: argparse.Namespace) -> Iterator[Row | str]:
    """The rows of the scenes that were asked for."""
    for name in options.scenes:
        try:
            scene = scenes.named(name, options.work)
        except (ValueError, FileNotFoundError) as error:
            yield str(error)
            continue
        yield from measure(scene, options.steps, options.work)


def measure(scene: scenes.Scene, steps: int, work: Path) -> Iterator[Row]:
    """Train a scene and yield a row for each format, or one that says why there are none."""
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
        for key in DOWNLOADS:
            yield rounded(row | {"outcome": "written"} | _written(storage, key, workdir))


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


def made(rows: list[Row]) -> str:
    steps = ", ".join(map(str, distinct(rows, "asked_steps")))
    text = f"Made by `splatmill bench formats` after {steps} steps at 480 pixels; CPU seconds of one thread."
    return f"{text}\n{footer(rows)}"


STUDY = Study(
    name="formats",
    about=__doc__,
    cases={"formats": measured},
    key=("scene", "format"),
    blocks={"formats": table, "footer": made},
    figures={},
    options={
        "scenes": {"nargs": "+", "default": ["synthetic", "fox"]},
        "steps": {"type": int, "default": 3000},
        "work": {"type": Path, "default": CACHE, "help": "where recovered cameras are kept"},
    },
)
main = STUDY.main
