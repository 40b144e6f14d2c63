"""What each file format of models costs: bytes, PSNR and SSIM on held-out photos, seconds to write and to read.

    splatmill bench formats                          # the still life and fox, 3000 steps each: about five minutes
    splatmill bench formats --scenes fox --steps 600
    splatmill bench formats --plot-only

Each scene is trained once, at 480 pixels with every 8th photo held out. Its model is written in every format, read
back, and compared with the held-out photos, as the renderer does for downloads. Seconds are CPU seconds of one thread,
since other programs disturb them less. Rows go to results/formats.jsonl, the table to formats.md.

Expected before it was measured: .glb without loss; .spz at an eighth of the bytes for 0.2 dB; .compressed.ply at a
fourth for 0.2 dB; .sog at a fourteenth for 0.4 dB, more where few steps leave much noise in the harmonics.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import torch
from _rows import HERE, Row, append, footer, lines, origin
from _train import scenes
from _train.child import prepared
from _train.run import rounded

from splatmill.backplane import layout
from splatmill.backplane.storage import Storage
from splatmill.schema import DOWNLOADS, Event, TrainOptions
from splatmill_worker import pipeline
from splatmill_worker.errors import Refusal
from splatmill_worker.render_service import conversion
from splatmill_worker.render_service.model_cache import ModelCache
from splatmill_worker.splat.formats import registry

CACHE = HERE.parent / "build" / "bench"
MODEL = "bench000formats0"


def main(argv: list[str]) -> int:
    """Measure the scenes that were asked for, and write the table."""
    parser = argparse.ArgumentParser(
        prog="splatmill bench formats",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--scenes", nargs="+", default=["synthetic", "fox"])
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--work", type=Path, default=CACHE, help="where recovered cameras are kept")
    parser.add_argument("--results", type=Path, default=HERE / "results" / "formats.jsonl")
    parser.add_argument("--plot-only", action="store_true", help="write the table of the rows that are there")
    asked = parser.parse_args(argv)
    if not asked.plot_only:
        for name in asked.scenes:
            try:
                scene = scenes.named(name, asked.work)
            except (ValueError, FileNotFoundError) as error:
                print(error, file=sys.stderr)
                continue
            measure(scene, asked.steps, asked.work, asked.results)
    found = lines(asked.results)
    if not found:
        print(f"There are no rows in {asked.results}.", file=sys.stderr)
        return 1
    own = asked.results.parent == HERE / "results"
    table = HERE / "formats.md" if own else asked.results.with_suffix(".md")
    table.write_text(document(found))
    print(f"Table: {table}")
    return 0


def measure(scene: scenes.Scene, steps: int, work: Path, results: Path) -> None:
    """Train a scene and append a row for each format, or one that says why there are none."""
    row: Row = {"bench": "formats", "scene": scene.name, "asked_steps": steps}
    ready = prepared(scene, work)
    if "failure" in ready:
        append(results, row | {"outcome": f"failed: {ready['failure']}"} | origin())
        return
    with tempfile.TemporaryDirectory(prefix="splatmill-bench-") as folder:
        workdir = Path(folder)
        (workdir / "sfm").symlink_to((work / scene.name / "sfm").resolve())
        options = TrainOptions.model_validate(scene.options | {"steps": steps, "seed": 0})
        try:
            outcome = pipeline.run(scene.folder, workdir, options, _quiet, lambda: False)
        except Refusal as failure:
            append(results, row | {"outcome": f"failed: {failure}"} | origin())
            return
        storage = _stored(outcome.out, workdir / "storage")
        torch.set_num_threads(1)
        for key in DOWNLOADS:
            found = row | {"outcome": "written"} | _written(storage, key, workdir)
            append(results, rounded(found) | origin())
            print(
                f"{scene.name} {key}: {found['bytes']:,} bytes, {found['psnr']:.2f} dB, "
                f"{found['write_seconds']:.2f} and {found['read_seconds']:.2f} s",
                flush=True,
            )


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


def document(rows: list[Row]) -> str:
    """The table of the newest row of each scene and format."""
    parts = [
        "| scene | format | bytes | smaller | held-out PSNR | loss | SSIM | seconds to write | to read | read by |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    newest = {(row["scene"], row.get("format")): row for row in rows}
    for (scene, key), row in newest.items():
        if row["outcome"] != "written" or key is None:
            parts.append(f"| {scene} | {row['outcome']} |" + " |" * 8)
            continue
        plain, form = newest[scene, "ply"], DOWNLOADS[key]
        parts.append(
            f"| {scene}, {row['gaussians']:,} Gaussians | `{form.suffix}` | {row['bytes']:,} "
            f"| {plain['bytes'] / row['bytes']:.1f}x | {row['psnr']:.2f} dB | {plain['psnr'] - row['psnr']:.2f} dB "
            f"| {row['ssim']:.3f} | {row['write_seconds']:.2f} | {row['read_seconds']:.2f} "
            f"| {', '.join(form.readers)} |"
        )
    shown = list(newest.values())
    steps = ", ".join(dict.fromkeys(str(row["asked_steps"]) for row in shown))
    parts += [
        "",
        f"Made by `splatmill bench formats` after {steps} steps at 480 pixels; CPU seconds of one thread.",
        footer(shown),
        "",
    ]
    return "\n".join(parts)
