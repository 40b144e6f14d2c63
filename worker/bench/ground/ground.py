"""A generated ground of more and more photos, from photos to the finished model: time, memory and quality.

    splatmill bench ground                                  # 125, 250, 500 and 1000 photos: many hours
    splatmill bench ground --photos 60 125 --visits 6 --image-size 320

The photos are those of `python -m splatmill_worker.synthetic ground`: the area grows with their number. Each row is
a whole command in a process of its own, with --max-memory: `splatmill train` in one piece, or `splatmill unit` over a
plan in tiles, one after the other on this machine. Steps are proportional to photos. CPU seconds and memory are those
of all processes of the command; other programs on the machine make the wall time longer, and their share is kept with
each row. The cameras are compared with the true ones after the best similarity.

Expected before it was measured: CPU seconds of a command grow as photos^1.0 to 1.2, memory in one piece with the number
of Gaussians, and memory in tiles hardly at all.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import _page
import _plot
import numpy as np
from _page import Column
from _rows import Row, distinct, footer, of
from _schedule import makespan
from _studies.study import Study
from matplotlib.figure import Figure
from sfm import aligned

from ground.commands import Usage, run
from splatmill.schema import TrainOptions
from splatmill_worker.colmap import pycolmap
from splatmill_worker.tiles.units import ScenePlan

SPLATMILL = [sys.executable, "-m", "splatmill"]
WAYS = ("in one piece", "in tiles")
MACHINES = (2, 4, 8)
"""Numbers of machines for which the time is worked out."""

KINDS = {"features": "features", "matches": "matches", "mapping": "mapping", "tile": "tiles", "seam": "seams"}
"""Kinds of units of which there are several, and what several are called."""
PHOTOS_PER_TILE = 30
"""Photos for each of which so many a scene gets one more tile, where --tiles does not say."""


def measured(options: argparse.Namespace) -> Iterator[Row | str]:
    """The rows of every number of photos, in one piece and in tiles."""
    for photos in options.photos:
        with tempfile.TemporaryDirectory(prefix="splatmill-bench-", dir=options.work) as name:
            folder = Path(name)
            words = ["ground", str(folder / "ground"), "--photos", str(photos), "--seed", str(options.seed)]
            made = run([sys.executable, "-m", "splatmill_worker.synthetic", *words], folder / "generate.log")
            if made.status != 0:
                yield f"{photos} photos could not be generated: {made.text}"
                continue
            for way in options.ways or WAYS:
                row: Row = {
                    "bench": "ground", "photos": photos, "way": way, "visits": options.visits,
                    "steps": options.visits * photos, "image_size": options.image_size,
                    "max_memory": options.max_memory, "seed": options.seed,
                    "generate_cpu": round(made.cpu, 1), "generate_memory": made.memory,
                }  # fmt: skip
                if way == "in tiles":
                    row["tiles"] = options.tiles or max(2, math.ceil(photos / PHOTOS_PER_TILE))
                yield row | commanded(row, folder)
                if options.logs is not None:
                    options.logs.mkdir(parents=True, exist_ok=True)
                    for log in folder.glob("*.log"):
                        shutil.copyfile(log, options.logs / f"{photos}-{way.replace(' ', '-')}-{log.name}")


def commanded(row: Row, folder: Path) -> Row:
    """The fields of one command over the ground in `folder`."""
    asked = ["--steps", str(row["steps"]), "--image-size", str(row["image_size"]), "--holdout", "8"]
    asked += ["--max-memory", row["max_memory"], "--seed", str(row["seed"])]
    photos = str(folder / "ground" / "photos")
    stages: dict[str, float] = {}
    if row["way"] == "in tiles":
        plan = folder / "plan"
        run(
            [*SPLATMILL, "plan", photos, "-o", str(plan), "--tiles", str(row["tiles"]), *asked],
            folder / "plan.log",
        )
        usage = run([*SPLATMILL, "unit", str(plan)], folder / "unit.log")
        out = plan / "scene"
        listed = [*SPLATMILL, "units", str(plan), "--json"]
        units = json.loads(subprocess.run(listed, capture_output=True, check=True, text=True).stdout)
        stages = {unit["unit"]: unit["seconds"] for unit in units if "seconds" in unit}
    else:
        out = folder / "piece"
        usage = run([*SPLATMILL, "train", photos, "-o", str(out), *asked], folder / "train.log")
    fields = used(usage)
    report = out / "report.json"
    if not report.is_file():
        return fields | {
            "failed": usage.text.strip().splitlines()[-1][:300] if usage.text.strip() else "silent"
        }
    told: dict[str, Any] = json.loads(report.read_text())
    result = told["result"]
    fields |= {name: result.get(name) for name in ("psnr", "ssim", "gaussians")}
    fields |= {"trained_steps": result.get("steps"), "warnings": told.get("warnings")}
    fields["stages"] = {name: round(s, 1) for name, s in (stages or told["seconds"]).items()}
    return fields | camera_errors(out / "cameras.json", folder / "ground" / "truth")


def used(usage: Usage) -> Row:
    """The fields of a command's usage."""
    return {
        "seconds": round(usage.seconds, 1), "cpu": round(usage.cpu, 1), "others": round(usage.others, 3),
        "memory": usage.memory, "memory_after": usage.memory_after,
        "silence": round(usage.silence[0], 1), "silence_after": usage.silence[1],
    }  # fmt: skip


def camera_errors(cameras: Path, truth: Path) -> Row:
    """Number of cameras, and their median and largest errors in degrees and metres after the best similarity."""
    poses = {
        each["name"]: np.array(each["camera"]["camera_to_world"])
        for each in json.loads(cameras.read_text())["cameras"]
    }
    true = {
        image.name: np.linalg.inv(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]))
        for image in pycolmap.Reconstruction(truth).images.values()
    }
    ours, theirs = np.array(list(poses.values())), np.array([true[name] for name in poses])
    distance, turn = aligned(ours[:, :3, 3], theirs[:, :3, 3])
    cosines = (
        np.trace(np.swapaxes(turn @ ours[:, :3, :3], 1, 2) @ theirs[:, :3, :3], axis1=1, axis2=2) - 1
    ) / 2
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return {
        "cameras": len(poses),
        "rotation_deg": round(float(np.median(angles)), 4), "rotation_deg_max": round(float(angles.max()), 4),
        "metres": round(float(np.median(distance)), 4), "metres_max": round(float(distance.max()), 4),
    }  # fmt: skip


COLUMNS: list[Column] = [
    ("photos:", "{photos}"),
    ("way", lambda row: f"{row['way']} ({row['tiles']})" if "tiles" in row else row["way"]),
    ("cameras:", lambda row: row.get("cameras", row.get("failed"))),
    (
        "error:",
        lambda row: f"{row['rotation_deg']:.3f}°, {100 * row['metres']:.1f} cm" if "metres" in row else "",
    ),
    ("CPU seconds:", "{cpu:.0f}"),
    ("wall seconds:", "{seconds:.0f}"),
    ("of the machine, others:", "{others:.0%}"),
    ("memory:", lambda row: f"{row['memory'] / 1e9:.2f} GB"),
    ("held-out PSNR:", lambda row: f"{row['psnr']:.2f} dB" if row.get("psnr") else ""),
    ("SSIM:", lambda row: f"{row['ssim']:.3f}" if row.get("ssim") else ""),
    ("Gaussians:", lambda row: f"{row['gaussians']:,}" if row.get("gaussians") else ""),
    ("longest silence:", lambda row: f"{row['silence']:.0f} s"),
]


def table(rows: list[Row]) -> str:
    return _page.of_rows(COLUMNS, rows)


def stages(rows: list[Row]) -> str:
    """The wall seconds of each stage or unit, and the lines before the most memory and before the longest silence."""
    lines = []
    for row in rows:
        parts = dict(row.get("stages", {}))
        for kind, plural in KINDS.items():
            times = [parts.pop(name) for name in list(parts) if name.startswith(f"{kind}-")]
            if times:
                parts[f"{len(times)} {plural}"] = round(sum(times), 1)
        text = ", ".join(f"{name} {seconds:.0f}" for name, seconds in parts.items() if seconds >= 0.5)
        memory, silence = (
            f"`{row[name][:70]}`" if row.get(name) else "" for name in ("memory_after", "silence_after")
        )
        lines.append([row["photos"], row["way"], text, memory, silence])
    return _page.table(
        "photos:|way|wall seconds of its stages|line before the most memory|line before the longest silence",
        lines,
    )


def machines(rows: list[Row]) -> str:
    """How long the units of each scene in tiles take on several machines, and on one."""
    lines = []
    for row in of(rows, way=WAYS[1]):
        units = row.get("stages", {})
        if "failed" in row or "photos" not in units:
            continue  # of a plan whose cameras were one unit
        plan = ScenePlan("", TrainOptions(tiles=row["tiles"]))
        one = makespan(plan, units, 1)
        parts = {
            name: sum(seconds for unit, seconds in units.items() if unit in members)
            for name, members in (
                ("cameras", plan.camera_names),
                ("coarse", ("coarse",)),
                ("tiles", plan.tile_names + plan.seam_names),
                ("scene", ("scene",)),
            )
        }
        times = [f"{makespan(plan, units, count):.0f} s" for count in MACHINES]
        share = makespan(plan, units, 4) / one
        spent = [f"{each:.0f} s" for each in (*parts.values(), one)]
        lines.append([row["photos"], row["tiles"], *spent, *times, f"{share:.2f}"])
    if not lines:
        return ""
    head = "photos:|tiles:|cameras:|coarse model:|tiles:|scene:|all in turn:"
    return _page.table(f"{head}|{'|'.join(f'{count} machines:' for count in MACHINES)}|4 to 1:", lines)


def exponent(rows: list[Row], name: str) -> float | None:
    """The exponent p of the least-squares fit `name` ~ photos^p; None with fewer than two numbers of photos."""
    known = [(row["photos"], row[name]) for row in rows if row.get(name) and "failed" not in row]
    if len({photos for photos, _ in known}) < 2:
        return None
    photos, values = np.log(np.array(known, float)).T
    return float(np.polyfit(photos, values, 1)[0])


def growth(rows: list[Row]) -> str:
    """One sentence for each way."""
    sentences = []
    for way in WAYS:
        powers = {
            words: exponent(of(rows, way=way), name)
            for name, words in (("cpu", "CPU seconds"), ("seconds", "wall seconds"), ("memory", "memory"))
        }
        known = [f"{words} as photos^{power:.2f}" for words, power in powers.items() if power is not None]
        if known:
            counts = ", ".join(str(count) for count in distinct(of(rows, way=way), "photos"))
            sentences.append(f"{way[0].upper()}{way[1:]}, by {counts} photos: {', '.join(known)}.")
    return "\n\n".join(sentences)


def generator(rows: list[Row]) -> str:
    """What making the photos takes."""
    if not rows:
        return ""
    per = [row["generate_cpu"] / row["photos"] for row in rows]
    most = max(row["generate_memory"] for row in rows)
    return (
        f"Making a photo takes {min(per):.2f} to {max(per):.2f} CPU seconds, the town's textures included, and the "
        f"command {most / 1e6:.0f} MB at most."
    )


def draw(rows: list[Row]) -> Figure:
    """CPU seconds and memory against photos."""
    figure, panels = _plot.axes(1, 2)
    for color, way in zip(_plot.CYCLE, WAYS, strict=False):
        whole = [row for row in of(rows, way=way) if "failed" not in row]
        photos = [row["photos"] for row in whole]
        for panel, values in zip(
            panels, ([row["cpu"] for row in whole], [row["memory"] / 1e9 for row in whole]), strict=True
        ):
            panel.plot(photos, values, "o-", color=color, label=way)
    for panel, title in zip(panels, ("CPU seconds", "memory, GB"), strict=True):
        panel.set(xscale="log", yscale="log", xlabel="photos", ylabel=title)
    panels[0].legend(fontsize=8)
    return figure


def made(rows: list[Row]) -> str:
    asked = "; ".join(
        dict.fromkeys(
            f"{row['visits']} steps for each photo, photos of {row['image_size']} pixels in training, --max-memory "
            f"{row['max_memory']}, seed {row['seed']}"
            for row in rows
        )
    )
    return f"Made by `splatmill bench ground` with {asked}.\n{footer(rows)}"


STUDY = Study(
    name="ground",
    about=__doc__,
    cases={"photos": measured},
    key=("photos", "way", "visits", "image_size", "max_memory", "seed"),
    order=lambda row: (row["photos"], WAYS.index(row["way"])),
    blocks={
        "growth": growth,
        "table": table,
        "stages": stages,
        "machines": machines,
        "generator": generator,
        "footer": made,
    },
    figures={"ground": draw},
    home=Path(__file__).resolve().parent,
    options={
        "photos": {"nargs": "+", "type": int, "default": [125, 250, 500, 1000]},
        "ways": {"nargs": "+", "choices": WAYS},
        "tiles": {"type": int, "help": f"left out, one for {PHOTOS_PER_TILE} photos"},
        "visits": {"type": int, "default": 20, "help": "training steps for each photo"},
        "image-size": {"type": int, "default": 640, "help": "longest side in training, in pixels"},
        "max-memory": {"default": "3GB"},
        "seed": {"type": int, "default": 0},
        "work": {"type": Path, "help": "folder for the photos and models while they are made"},
        "logs": {"type": Path, "help": "folder that keeps what the commands printed"},
    },
)
main = STUDY.main
