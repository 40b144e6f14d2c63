"""A scene in tiles against the same scene in one piece: quality, seams, and what each unit takes.

    splatmill bench tiles                              # still life and captures, four tiles: an hour or two
    splatmill bench tiles --scenes still --tiles 2 9 --steps 400 --dry

Each scene is trained by the same options in one piece and in tiles, with the same cameras. Every unit is a process of
its own, of which the CPU seconds and the largest memory are measured. "In turn" is the CPU time of all units; "longest
chain" is what is left where each tile has a machine of its own: the coarse model, the longest tile and the longest
of their last steps, and the joining.

Expected before it was measured: the same PSNR within 0.3 dB, less on seams than elsewhere by a tenth, and for four
tiles half of the memory of one piece in each unit beside that of the program.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from statistics import mean
from typing import Any

import _page
import _plot
from _data import FOLDERS, SHARED
from _rows import Row, distinct, footer, of
from _studies.study import Study
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from splatmill.schema import TrainOptions
from splatmill_worker.synthetic import capture as still_life
from splatmill_worker.tiles.folder import PlanFolder, digest_of, facts_of
from splatmill_worker.tiles.units import ScenePlan

ONE_PIECE = """
import json, sys
from pathlib import Path
from splatmill.schema import TrainOptions
from splatmill_worker import pipeline
capture, work, options = sys.argv[1:]
run = pipeline.run(Path(capture), Path(work), TrainOptions.model_validate_json(options), lambda e: None, lambda: False)
held_out = run.trained.held_out
print(json.dumps({"psnr": held_out.psnr, "ssim": held_out.ssim, "gaussians": run.trained.gaussians.count,
                  "trained_steps": run.trained.steps}))
"""


def measured(options: argparse.Namespace) -> Iterator[Row | str]:
    """The rows of all scenes: in one piece, then in each number of tiles."""
    for scene in options.scenes:
        with tempfile.TemporaryDirectory(prefix="splatmill-bench-", dir=options.work) as folder:
            capture = Path(folder) / "capture"
            if scene == "still":
                still_life(capture)
            elif scene in FOLDERS and (SHARED / FOLDERS[scene]).is_dir():
                # Cameras of photos with alpha alone: those of the others are recovered.
                part = "" if (SHARED / FOLDERS[scene] / "train").is_dir() else "images"
                shutil.copytree(SHARED / FOLDERS[scene] / part, capture / part)
            else:
                yield f"{scene} is left out: there is no such capture."
                continue
            yield from compared(scene, Path(folder), options)


def compared(scene: str, folder: Path, options: argparse.Namespace) -> Iterator[Row | str]:
    """One scene in one piece, and in tiles with the cameras of that."""
    asked = TrainOptions.model_validate(
        {"steps": options.steps, "image_size": options.image_size, "holdout": 8, "seed": options.seed}
    )
    row: Row = {"bench": "tiles", "scene": scene, "steps": options.steps, "seed": options.seed}
    work = folder / "one"
    work.mkdir()
    digest = digest_of(folder / "capture")
    cameras = None
    for tiles in options.tiles:
        root = folder / f"tiles-{tiles}"
        root.mkdir()
        plan = PlanFolder(root, ScenePlan(digest, asked.model_copy(update={"tiles": tiles})))
        plan.capture.parent.mkdir()
        plan.capture.symlink_to(folder / "capture")
        plan.save()
        if cameras is not None:
            shutil.copytree(cameras, root / "units" / cameras.name)
        units: dict[str, dict[str, float]] = {}
        while ready := plan.plan.ready(plan.states()):
            status, units[ready[0]], text = timed("-m", "splatmill_worker", "unit", str(root), ready[0])
            if status != 0:
                yield f"{scene} in {tiles} tiles: {ready[0]} failed: {text.strip().splitlines()[-1]}"
                return
        ended = plan.ended()
        if cameras is None:
            cameras = ended["cameras"].path
            assert cameras is not None
            if (cameras / "sfm").is_dir():
                shutil.copytree(cameras / "sfm", work / "sfm")
            status, use, text = timed(
                "-c", ONE_PIECE, str(folder / "capture"), str(work), asked.model_dump_json()
            )
            if status != 0:
                yield f"{scene} in one piece failed: {text.strip().splitlines()[-1]}"
                return
            yield row | {"tiles": 1, **json.loads(text.splitlines()[-1]), **use}
        yield row | {"tiles": tiles, **in_tiles(plan, units)}


def in_tiles(plan: PlanFolder, units: dict[str, dict[str, float]]) -> Row:
    """The fields of a scene in tiles."""
    ended = plan.ended()
    facts: dict[str, Any] = {name: facts_of(end.path) for name, end in ended.items() if end.path is not None}
    scene, trained = facts["scene"], [name for name in units if name.startswith(("tile", "seam"))]
    seams = scene["seams"] or {}
    gain = {part: (seams.get(part) or 0) - (seams.get(f"coarse_{part}") or 0) for part in ("seams", "others")}
    longest = sum(
        max(units[name]["cpu"] for name in trained if name.startswith(kind)) for kind in ("tile", "seam")
    )
    return {
        **{name: scene[name] for name in ("psnr", "ssim", "gaussians")},
        "trained_steps": scene["steps"],
        "coarse_psnr": facts["coarse"]["psnr"],
        "cpu": round(sum(use["cpu"] for name, use in units.items() if name not in plan.plan.camera_names), 1),
        "chain": round(units["coarse"]["cpu"] + longest + units["scene"]["cpu"], 1),
        "memory": max(units[name]["memory"] for name in ("coarse", *trained)),
        "seam_share": seams.get("share"),
        "seam_cost": gain["others"] - gain["seams"],
        "units": units,
    }


def timed(*arguments: str) -> tuple[int, dict[str, float], str]:
    """The exit status of a Python program, its CPU seconds and largest memory in bytes, and what it printed."""
    with tempfile.TemporaryFile("w+") as output:
        child = subprocess.Popen([sys.executable, *arguments], stdout=output, stderr=subprocess.STDOUT)
        _, status, use = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        text = output.read()
    figures = {"cpu": round(use.ru_utime + use.ru_stime, 1), "memory": use.ru_maxrss * 1024}
    return child.returncode, figures, text


KINDS = {"coarse": "coarse model", "tile": "tiles", "seam": "their last steps", "scene": "whole scene"}
"""Labels of the kinds of units, by what their names begin with."""

Pair = tuple[Row, Row]
"""The row of one piece, and that of tiles with the same seed."""


def compared_scenes(rows: list[Row]) -> list[list[Pair]]:
    """The pairs of each scene and number of tiles, by seed."""
    by_scene: dict[tuple[Any, ...], list[Pair]] = {}
    for row in rows:
        if row["tiles"] > 1:
            for one in of(rows, scene=row["scene"], steps=row["steps"], seed=row["seed"], tiles=1):
                by_scene.setdefault((row["scene"], row["tiles"], row["steps"]), []).append((one, row))
    return [sorted(pairs, key=lambda pair: pair[0]["seed"]) for pairs in by_scene.values()]


def difference(pair: Pair) -> float:
    """PSNR in tiles less that in one piece, dB."""
    one, row = pair
    return float(row["psnr"] - one["psnr"])


def means(pairs: list[Pair], field: str) -> tuple[float, float]:
    """The means of a field over the seeds: in one piece, and in tiles."""
    ones, rows = zip(*pairs, strict=True)
    return mean(one[field] for one in ones), mean(row[field] for row in rows)


def table(rows: list[Row]) -> str:
    lines = []
    for pairs in compared_scenes(rows):
        (whole, tiles), (ssim, tiled), (many, few) = (means(pairs, x) for x in ("psnr", "ssim", "gaussians"))
        each = ", ".join(f"{difference(pair):+.2f}" for pair in pairs)
        cost = mean(row["seam_cost"] for _, row in pairs)
        lines.append(
            [
                pairs[0][1]["scene"], pairs[0][1]["tiles"], f"{whole:.2f} dB", f"{tiles:.2f} dB",
                f"{tiles - whole:+.2f} dB", each, f"{ssim:.4f}", f"{tiled:.4f}", f"{many:,.0f}", f"{few:,.0f}",
                f"{cost:+.2f} dB",
            ]
        )  # fmt: skip
    head = "scene|tiles:|PSNR in one piece:|in tiles:|difference:|of each seed:|SSIM in one piece:|in tiles:"
    return _page.table(f"{head}|Gaussians in one piece:|in tiles:|seams cost:", lines)


def costs(rows: list[Row]) -> str:
    head = (
        "scene|tiles:|CPU seconds in one piece:|units in turn:|longest chain:|memory in one piece:|of a unit:"
    )
    lines = [
        [
            row["scene"], row["tiles"], f"{one['cpu']:.0f}", f"{row['cpu']:.0f}", f"{row['chain']:.0f}",
            f"{one['memory'] / 1e6:.0f} MB", f"{row['memory'] / 1e6:.0f} MB",
        ]
        for (one, row), *_ in compared_scenes(rows)
    ]  # fmt: skip
    return _page.table(head, lines)


def conclusion(rows: list[Row]) -> str:
    """The least and the largest mean difference to one piece."""
    scenes = [(mean(map(difference, pairs)), pairs[0][1]["scene"]) for pairs in compared_scenes(rows)]
    if not scenes:
        return ""
    (least, worst), (most, best) = min(scenes), max(scenes)
    return (
        f"PSNR in tiles is {least:+.2f} dB ({worst}) to {most:+.2f} dB ({best}) of that in one piece, "
        f"in the mean over seeds; over all captures, {mean(each for each, _ in scenes):+.2f} dB."
    )


def draw(rows: list[Row]) -> Figure:
    """CPU seconds of each unit, stacked, beside those of one piece."""
    both = [pairs[0] for pairs in compared_scenes(rows)]
    figure, panels = _plot.axes(1, 1, width=6.0, height=0.5 + 0.55 * max(1, len(both)))
    panel = panels[0]
    for place, (one, row) in enumerate(both):
        panel.barh(place + 0.2, one["cpu"], height=0.35, color=_plot.CYCLE[0])
        left = 0.0
        for name, use in row["units"].items():
            kind = name.partition("-")[0]
            if kind not in KINDS:
                continue
            color = _plot.CYCLE[1 + list(KINDS).index(kind)]
            panel.barh(place - 0.2, use["cpu"], left=left, height=0.35, color=color, edgecolor="white")
            left += use["cpu"]
    handles = [Patch(color=_plot.CYCLE[0], label="in one piece")]
    handles += [
        Patch(color=_plot.CYCLE[1 + number], label=label) for number, label in enumerate(KINDS.values())
    ]
    panel.legend(handles=handles, fontsize=7, loc="lower right")
    panel.set_yticks(
        range(len(both)), [f"{row['scene']}, {row['tiles']} tiles" for _, row in both], fontsize=7
    )
    _plot.name(panel, "CPU seconds of the first seed", size=8)
    return figure


def made(rows: list[Row]) -> str:
    steps, seeds = (", ".join(str(x) for x in distinct(rows, name)) for name in ("steps", "seed"))
    by = f"Made by `splatmill bench tiles` with {steps} steps and the seeds {seeds}, without the cameras."
    return f"{by}\n{footer(rows)}"


STUDY = Study(
    name="tiles",
    about=__doc__,
    cases={"scenes": measured},
    key=("scene", "tiles", "steps", "seed"),
    blocks={"conclusion": conclusion, "table": table, "costs": costs, "footer": made},
    figures={"tiles": draw},
    options={
        "scenes": {
            "nargs": "*",
            "default": ["still", "fox", "kermit", "lund", "snowmiku", "beer", "lego", "room"],
        },
        "tiles": {"nargs": "+", "type": int, "default": [4]},
        "steps": {"type": int, "default": 3000},
        "image-size": {"type": int, "default": 480},
        "seed": {"type": int, "default": 0},
        "work": {"type": Path, "help": "folder for the captures while they are trained"},
    },
)
main = STUDY.main
