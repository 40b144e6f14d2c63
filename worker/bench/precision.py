# ruff: noqa: E501  (prose and rows of Markdown tables are as long as they are)
"""`bench precision`: what narrower storage and rougher blending save, and what they cost in exactness and in held-out PSNR.

    splatmill bench precision                              # compiles the variants, then every part: over an hour
    splatmill bench precision --parts time error decay     # what needs no training but one of each scene
    splatmill bench precision --only moments_nearest --parts decay
    splatmill bench precision --plot-only

Each variant is a build of the C++ kernels with other compile definitions (`_precision/variants.py`), made for the
instruction set in use, in a folder of the benchmark; the installed engine is not touched. All are measured in one process, in turning
order. Trainings that have a row of the present code are not repeated.

Expected before it was measured: the update is bound by memory, and moments in bf16 move 16 bytes a value in place of 24,
a third less of a pass that is a quarter of the step at 100,000 Gaussians: 5 to 8 % of the step there, 1 to 2 % at 10,000.
Records of half a cache line gain little, since they are fetched ahead: 0 to 3 %. Coefficients in 16 bits save a quarter of
the update's bytes and half of the projection's: 5 % at 100,000. Tiles of 8 list more pairs for the same blocks: slower. A cut at 1/64
removes a fifth of the area of an ellipse of opacity 1/2, so 10 to 20 % of the passes over pixels, for an error of whole 8-bit steps.
The end at 1e-2 saves most where scenes are opaque: 5 to 10 %. A second moment in bf16, rounded to nearest, cannot fall by
0.1 % a step, as half an ulp is 0.2 to 0.4 %: it keeps its largest value, and steps become too short.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

import _scenes
from _precision.builds import compiled
from _precision.measure import Modules, decay, errors, timed
from _precision.report import draw, table
from _precision.trainings import settled, trained
from _precision.variants import BY_NAME, EXACT, PLAIN, VARIANTS, Variant
from _rows import HERE, Row, append, lines, origin
from _train import scenes
from _train.child import prepared
from _train.rows import code_version

CACHE = HERE.parent / "build" / "precision"
ROWS = HERE / "results" / "precision.jsonl"
PARTS = ("time", "error", "decay", "training")
SCENES = ("synthetic", "fox", "lund", "lego")
AFTER = (1, 10, 100, 250, 500, 1000, 2000)
"""Steps out of view after which second moments are read."""

COUNTS = (None, 30_000, 100_000)
"""Gaussians of the fox that steps are timed on; None: its SfM points, 11,000."""


def main(argv: list[str]) -> int:
    """Measure the parts that were asked for, and write table and figure."""
    parser = argparse.ArgumentParser(
        prog="splatmill bench precision",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--only", nargs="+", choices=BY_NAME, help="these variants, beside float32")
    parser.add_argument("--scenes", nargs="+", default=SCENES, help="scenes of bench train, or folders")
    parser.add_argument("--steps", type=int, default=400, help="of each training")
    parser.add_argument(
        "--size", type=int, default=240, help="longest side of the photos in trainings, pixels"
    )
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--views", type=int, default=12, help="views of a round of timings")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--work", type=Path, default=CACHE, help="builds, photos and recovered cameras")
    parser.add_argument("--rows", type=Path, default=ROWS)
    parser.add_argument("--report", type=Path, default=HERE, help="the folder of precision.md and figures/")
    parser.add_argument("--plot-only", action="store_true", help="table and figure from the rows there are")
    options = parser.parse_args(argv)
    if not options.plot_only:
        chosen = [v for v in VARIANTS if not options.only or v is PLAIN or v.name in options.only]
        exact = [EXACT] if "error" in options.parts else []
        modules = compiled([*chosen, *exact], options.work)
        measured(options, chosen, modules)
    found = lines(options.rows)
    draw(found, options.report / "figures" / "precision.png")
    (options.report / "precision.md").write_text(table(found))
    return 0


def measured(options: argparse.Namespace, chosen: list[Variant], modules: Modules) -> None:
    """Measure the parts; each row is written as soon as it is there."""
    seen = {"error", "training"} & {*options.parts}
    known = captures(options.scenes, options.work) if seen else []
    training = {"steps": options.steps, "image_size": options.size}

    def keep(rows: Iterable[Row]) -> None:
        for row in rows:
            print({k: v for k, v in row.items() if not isinstance(v, (dict, list))}, flush=True)
            append(options.rows, row | origin())

    if "decay" in options.parts:
        for variant in chosen:
            if variant.kind in ("shipped", "moments"):
                keep(decay(variant, modules, AFTER))
    if "error" in options.parts:
        for capture in known:
            keep(errors(settled(capture, training, options.work), chosen, modules))
    if "time" in options.parts:
        for scene in timing_scenes(options.views):
            for threads in options.threads:
                keep(timed(scene, chosen, modules, threads, options.rounds))
    if "training" in options.parts:
        there = {_key(row) for row in lines(options.rows) if row["kind"] == "training"}
        for seed in range(options.seeds):
            for capture in known:
                for variant in chosen:
                    row = {"variant": variant.name, "scene": capture.name, "seed": seed, "size": options.size,
                           "steps": options.steps, "code": code_version()}  # fmt: skip
                    if _key(row) not in there:
                        keep([trained(capture, variant, modules, seed, training, options.work)])


def _key(row: Row) -> tuple[object, ...]:
    return tuple(row.get(name) for name in ("variant", "scene", "seed", "size", "steps", "code"))


def captures(names: Sequence[str], work: Path) -> list[scenes.Scene]:
    """The scenes with their cameras; those that are not there are left out with a word."""
    found = []
    for name in names:
        try:
            scene = scenes.named(name, work)
        except FileNotFoundError as absent:
            print(absent)
            continue
        prepared(scene, work)
        found.append(scene)
    return found


def timing_scenes(views: int) -> list[_scenes.Scene]:
    """The fox at growing numbers of Gaussians; without the shared photos, a cloud."""
    found = []
    for count in COUNTS:
        scene = _scenes.fox(480, count)
        if scene is None:
            scene = _scenes.cloud(count or 11_000, 270, 480)
        scene.views = scene.views[:: max(1, len(scene.views) // views)][:views]
        found.append(scene)
    return found


if __name__ == "__main__":
    import sys

    sys.exit(main(sys.argv[1:]))
