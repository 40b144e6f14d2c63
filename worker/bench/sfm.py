"""Cameras against time: scenes x settings, pose error, registered share, and what a short training makes of them.

    python -m splatmill_worker bench sfm                          # all scenes, with training; about 20 minutes
    python -m splatmill_worker bench sfm --scenes fox kermit --settings auto --again --no-train
    python -m splatmill_worker bench sfm --growth                 # 25 to 500 generated photos, and the fit

A row that is there is not measured again, unless by --again; without a training of --train seconds it is not whole.
Rules: photos come from ../shared/data, and a scene that is not there gets no row; every run starts from an empty
folder; a failed run gets no point in the figure and is named in the table. A row during which other programs took
more than a tenth of the machine's time is marked "busy": its seconds are too high and its PSNR too low.
With --growth, "report" is the longest time between two reports of progress, and GB the largest resident memory of the
process so far; counts are measured in the order in which they are given.
Pose errors are medians after the best similarity to the reference: for fox COLMAP's model of the full-size photos
(itself no truth: its principal point was held), for generated photos the true cameras, for lund the GPS places (10 m
accurate), positions only, which may have taken part in the last adjustment. beer has none: in the
COLMAP model that came with it, the camera turns by 167 to 174 degrees between neighbouring frames of a video three
times (decisions: unfold). Held-out PSNR is that of the default pipeline trained for --train seconds on the cameras with
the points of structure from motion, longest side 480; stereo adds to them where the pipeline would.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _data
import _rows
import numpy as np
import numpy.typing as npt
import psutil
from _page import Column, of_rows
from _plot import axes
from _rows import Row, of
from _studies.study import Study
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from splatmill.schema import TrainOptions
from splatmill_worker import pipeline, sfm, synthetic
from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.prepare import prepare
from splatmill_worker.scene import Camera, Scene
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.matching import pairs
from splatmill_worker.sfm.posed import colmap_model
from splatmill_worker.sfm.posed.files import ImageFiles
from splatmill_worker.synthetic import textures

Float = npt.NDArray[np.float64]
NAMES = ("fox", "lund", "kermit", "beer", "snowmiku", "room", "unrelated", "rotation")
FOLDERS = {name: _data.FOLDERS[name] for name in NAMES}
MISPLACED = ("beer",)  # cameras that came with the capture are wrong
COUNTS = (25, 50, 100, 200, 500)
GROWTH_WIDTH, GROWTH_HEIGHT = 480, 360
TRAIN_SIDE = 480
BUSY = 0.1  # of the machine's time, taken by other programs


@dataclass(frozen=True)
class Result:
    """The result of one setting on a scene: the posed scene or the failure's code, and the seconds of each stage."""

    scene: Scene | None
    failure: str | None
    seconds: dict[str, float]
    facts: dict[str, Any]


class Waits:
    """The longest time, in seconds, between two reports of progress, from the start on."""

    def __init__(self) -> None:
        self.last, self.longest = time.perf_counter(), 0.0

    def __call__(self, stage: str, done: int, total: int, note: str) -> None:
        now = time.perf_counter()
        self.longest, self.last = max(self.longest, now - self.last), now


def ours(options: sfm.SfmOptions) -> Callable[[Path, Path], Result]:
    def run(images: Path, workdir: Path) -> Result:
        waits = Waits()
        try:
            scene = sfm.reconstruct(images, None, workdir, options, waits, lambda: False)
        except sfm.SfmFailed as failed:
            return Result(None, failed.code, {}, failed.facts)
        return Result(
            scene, None, scene.facts["seconds"], scene.facts | {"longest_wait": round(waits.longest, 2)}
        )

    return run


def defaults(images: Path, workdir: Path) -> Result:
    """COLMAP's own pipeline: 1000 pixels, 4096 features, exhaustive matching, one camera, incremental mapping."""
    workdir.mkdir(parents=True)
    database, models = workdir / "database.db", workdir / "models"
    models.mkdir()
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size, extraction.sift.max_num_features = 1000, 4096
    seconds, clock = {}, time.perf_counter()

    def lap(stage: str) -> None:
        nonlocal clock
        seconds[stage], clock = round(time.perf_counter() - clock, 3), time.perf_counter()

    pycolmap.extract_features(
        database, images, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=extraction
    )
    lap("features")
    pycolmap.match_exhaustive(database)
    lap("matching")
    made = pycolmap.incremental_mapping(database, images, models)
    lap("mapping")
    if not made:
        return Result(None, "no model", seconds, {"registered": 0})
    model = max(made.values(), key=lambda model: model.num_reg_images())
    if model.num_reg_images() < 3:
        return Result(
            None, f"{model.num_reg_images()} registered", seconds, {"registered": model.num_reg_images()}
        )
    folder = workdir / "largest"
    folder.mkdir()
    model.write_binary(folder)
    scene = colmap_model.load(folder, ImageFiles.under(images.parent))
    facts = {
        "registered": len(scene.views),
        "points": len(scene.points),
        "reprojection_pixels": round(model.compute_mean_reprojection_error(), 3),
    }
    return Result(scene, None, seconds, facts)


SETTINGS: dict[str, Callable[[Path, Path], Result]] = {
    "COLMAP defaults": defaults,
    "auto": ours(sfm.SfmOptions()),
    "lean": ours(sfm.SfmOptions(effort="lean")),
    "standard": ours(sfm.SfmOptions(effort="standard")),
    "lean, all pairs": ours(sfm.SfmOptions(effort="lean", matcher="exhaustive")),
    "lean, global": ours(sfm.SfmOptions(effort="lean", mapper="global")),
}


def aligned(ours: Float, theirs: Float) -> tuple[Float, Float]:
    """Distances [n], as `theirs`, after the least-squares similarity (Umeyama 1991), and its rotation [3, 3]."""
    a, b = ours - ours.mean(0), theirs - theirs.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u @ sign @ vt
    scale = float(np.trace(np.diag(s) @ sign) / (a**2).sum())
    return np.linalg.norm(scale * a @ turn.T - b, axis=1), turn


def pose_error(scene: Scene, truth: dict[str, Camera]) -> dict[str, float]:
    """Median and largest rotation error in degrees, and position error in per cent of the cameras' spread."""
    views = [view for view in scene.views if view.name in truth]
    if len(views) < 3:
        return {}
    centers = np.array([truth[view.name].center for view in views])
    distance, turn = aligned(np.array([view.camera.center for view in views]), centers)
    angles = [
        math.degrees(
            math.acos(
                np.clip(
                    (np.trace(v.camera.viewmat[:3, :3] @ turn.T @ truth[v.name].viewmat[:3, :3].T) - 1) / 2,
                    -1,
                    1,
                )
            )
        )
        for v in views
    ]
    spread = np.linalg.norm(centers - centers.mean(0), axis=1).max()
    return {
        "rotation_deg": round(float(np.median(angles)), 3),
        "rotation_deg_max": round(float(np.max(angles)), 3),
        "position_percent": round(100 * float(np.median(distance) / spread), 3),
        "position_percent_max": round(100 * float(distance.max() / spread), 3),
    }


def gps_error(scene: Scene, images: Path, workdir: Path) -> dict[str, float]:
    """Median distance in metres to the GPS positions of the photos; empty where they have none."""
    photos = {photo.name: photo for photo in prepare(images, None, workdir).photos}
    views = [view for view in scene.views if view.name in photos]
    places = pairs.gps_positions([photos[view.name] for view in views])
    if len(views) < 4 or not np.isfinite(places).all():
        return {}
    places[:, 2] = 0.0  # heights are too noisy to compare with
    distance, _ = aligned(np.array([view.camera.center for view in views]), places)
    return {"gps_metres": round(float(np.median(distance)), 2)}


def trained_psnr(scene: Scene, seconds: float, workdir: Path) -> dict[str, float]:
    """Held-out PSNR after `seconds` of training the default pipeline on these cameras."""
    capture = workdir / "capture"
    model_folder = capture / "sparse" / "0"
    model_folder.mkdir(parents=True)
    (capture / "images").symlink_to(scene.views[0].image.parent)
    as_model(scene).write_binary(model_folder)
    options = TrainOptions(time_budget=seconds, image_size=TRAIN_SIDE)
    outcome = pipeline.run(capture, workdir / "train", options, lambda _: None, lambda: False)
    score = outcome.trained.held_out if outcome.trained is not None else None
    return {} if score is None else {"psnr": round(score.psnr, 3), "ssim": round(score.ssim, 4)}


def as_model(scene: Scene) -> pycolmap.Reconstruction:
    """The scene as a COLMAP model under the photos' own names, with SfM's own points and their tracks."""
    model = pycolmap.Reconstruction()
    for number, view in enumerate(scene.views, 1):
        camera = view.camera
        if view.lens is None:
            params = [camera.fx, camera.fy, camera.cx, camera.cy]
            made = pycolmap.Camera(
                model="PINHOLE", width=camera.width, height=camera.height, params=params, camera_id=number
            )
        else:
            lens = view.lens
            made = pycolmap.Camera(
                model=lens.model,
                width=lens.width,
                height=lens.height,
                params=list(lens.params),
                camera_id=number,
            )
        model.add_camera_with_trivial_rig(made)
        image = pycolmap.Image(name=view.name, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.viewmat[:3]))
    assert scene.point_views is not None
    offsets, views = scene.point_views
    places: dict[int, list[Float]] = {number: [] for number in range(1, len(scene.views) + 1)}
    elements: list[list[tuple[int, int]]] = []
    for index in range(scene.facts.get("sparse_points", len(scene.points))):
        row = []
        for view_index in views[offsets[index] : offsets[index + 1]]:
            image_id = int(view_index) + 1
            row.append((image_id, len(places[image_id])))
            places[image_id].append(np.zeros(2))
        elements.append(row)
    for image_id, points in places.items():
        model.images[image_id].points2D = pycolmap.Point2DList([pycolmap.Point2D(place) for place in points])
    for index, row in enumerate(elements):
        track = pycolmap.Track([pycolmap.TrackElement(*element) for element in row])
        model.add_point3D(scene.points[index], track, scene.colors[index])
    return model


def measure(
    name: str, images: Path, setting: str, truth: dict[str, Camera], train: float | None
) -> dict[str, Any]:
    """One row: a run of `setting` from an empty folder, its errors, and the training on top."""
    with tempfile.TemporaryDirectory(prefix="splatmill-bench-") as folder:
        wall, cpu, machine = time.perf_counter(), time.process_time(), _rows.worked()
        result = SETTINGS[setting](images, Path(folder) / "sfm")
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        others = max(0.0, _rows.worked() - machine - cpu)
        row: dict[str, Any] = {
            "scene": name,
            "setting": setting,
            "photos": len([path for path in images.iterdir() if path.is_file()]),
            "registered": result.facts.get("registered", 0),
            "outcome": result.failure or "placed",
            "seconds": round(wall, 2),
            "cpu_seconds": round(cpu, 2),
            "busy": others > BUSY * wall * (psutil.cpu_count() or 1),
            "stages": result.seconds,
            "points": result.facts.get("points", 0),
            "stereo_points": result.facts.get("stereo_points", 0),
            "reprojection_pixels": result.facts.get("reprojection_pixels"),
            "effort": result.facts.get("effort"),
            "mapper": result.facts.get("mapper"),
            "longest_wait": result.facts.get("longest_wait"),
            "peak_bytes": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        }
        if result.scene is not None:
            row |= pose_error(result.scene, truth) | gps_error(result.scene, images, Path(folder) / "look")
            if train is not None:
                cpu, machine, wall = time.process_time(), _rows.worked(), time.perf_counter()
                row |= {"train": train} | trained_psnr(result.scene, train, Path(folder))
                others = _rows.worked() - machine - (time.process_time() - cpu)
                row["busy"] |= others > BUSY * (time.perf_counter() - wall) * (psutil.cpu_count() or 1)
        return row


def reference(name: str) -> dict[str, Camera]:
    """The reference cameras of a scene; none where there are none to trust."""
    poses = None if name in MISPLACED else posed.find(_data.SHARED / FOLDERS[name])
    return {view.name: view.camera for view in poses.load().views} if poses is not None else {}


def scenes_bench(options: argparse.Namespace) -> Iterator[Row | str]:
    """Measure the combinations of scene and setting that have no whole row."""
    train = None if options.no_train else options.train
    for name in options.scenes:
        images = _data.SHARED / FOLDERS[name] / "images"
        if not images.is_dir():
            yield f"{name} is not here ({images}); no row for it."
            continue
        for setting in options.settings:
            if options.again or not any(
                train is None or row["outcome"] != "placed" or row.get("train") == train
                for row in of(options.known, scene=name, setting=setting)
            ):
                yield measure(name, images, setting, reference(name), train)


def growth_bench(options: argparse.Namespace) -> Iterator[Row]:
    """Seconds against the number of photos, on generated orbits of constant overlap between neighbours.

    Taking the photos is not on the clock, and each set is taken once in each size by each version of the generator.
    """
    sources = [Path(str(module.__file__)).read_bytes() for module in (synthetic, textures)]
    place = Path(tempfile.gettempdir()) / "splatmill-bench-growth"
    version = hashlib.sha256(b"".join(sources)).hexdigest()[:12]
    for count in options.counts:
        name = f"still life {count}"
        if of(options.known, scene=name) and not options.again:
            continue
        folder = place / f"{count}-{GROWTH_WIDTH}x{GROWTH_HEIGHT}-{version}"
        poses = folder / "poses.json"
        if not poses.is_file():
            made = synthetic.capture(folder / "images", count, GROWTH_WIDTH, GROWTH_HEIGHT)
            poses.write_text(json.dumps({n: [c.K.tolist(), c.viewmat.tolist()] for n, c in made.items()}))
        truth = {
            n: Camera(GROWTH_WIDTH, GROWTH_HEIGHT, K[0][0], K[1][1], K[0][2], K[1][2], np.array(viewmat))
            for n, (K, viewmat) in json.loads(poses.read_text()).items()
        }
        yield measure(name, folder / "images", "auto", truth, None)


def exponent(rows: list[Row], key: str = "cpu_seconds") -> float:
    """The slope of log seconds over log photos, by least squares."""
    photos = np.log([row["photos"] for row in rows])
    return float(np.polyfit(photos, np.log([row[key] for row in rows]), 1)[0])


def growth_table(rows: list[Row]) -> str:
    """The table with what grows beside the seconds."""

    def gigabytes(row: Row) -> str:
        return f"{row['peak_bytes'] / 1e9:.2f}" if "peak_bytes" in row else ""

    return table(rows, [("report, s", lambda row: row.get("longest_wait", "")), ("GB", gigabytes)])


def table(rows: list[Row], more: Sequence[Column] = ()) -> str:
    def of_field(name: str) -> Callable[[Row], object]:
        return lambda row: "" if row.get(name) is None else row[name]

    columns: list[Column] = [
        ("photos", "{registered} of {photos}"), ("scene", "{scene}"), ("setting", "{setting}"),
        ("outcome", "{outcome}"), ("s", lambda row: f"{row['seconds']}{' (busy)' * row['busy']}"),
        ("CPU s", "{cpu_seconds}"), ("points", "{points}"), ("reproj. px", of_field("reprojection_pixels")),
        ("rotation °", of_field("rotation_deg")), ("position %", of_field("position_percent")),
        ("GPS m", of_field("gps_metres")), ("PSNR dB", of_field("psnr")), *more,
    ]  # fmt: skip
    return of_rows(columns, rows)


def scenes_figure(rows: list[Row]) -> Figure:
    """Left: held-out PSNR, right: pose error, both over the seconds that the cameras took."""
    figure, (left, right) = axes(2)
    colors = {name: f"C{index}" for index, name in enumerate(FOLDERS)}
    markers = dict(zip(SETTINGS, "sovD^P", strict=True))
    for row in of(rows, outcome="placed"):
        color = colors[row["scene"]]
        face = "none" if row["busy"] else color
        marker = markers[row["setting"]]
        style: dict[str, Any] = {"edgecolors": color, "facecolors": face, "marker": marker, "s": 48}
        label = f"{row['scene']}, {row['setting']}"
        if "psnr" in row:
            left.scatter(row["seconds"], row["psnr"], label=label, **style)
        if "rotation_deg" in row:
            right.scatter(row["seconds"], row["rotation_deg"], label=label, **style)
    left.set(xscale="log", xlabel="seconds for the cameras", ylabel="held-out PSNR, dB")
    right.set(xscale="log", xlabel="seconds for the cameras", ylabel="median rotation error, degrees")
    for axis in (left, right):
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        axis.xaxis.set_minor_formatter(NullFormatter())
    (left if left.has_data() else right).legend(fontsize=7)
    failed = [
        f"{row['scene']}, {row['setting']}: {row['outcome']}" for row in rows if row["outcome"] != "placed"
    ]
    hollow = " · hollow: on a busy machine" if any(row["busy"] for row in rows) else ""
    figure.set_label(f"{hollow} · no point for: {'; '.join(failed)}" if failed else hollow)
    return figure


def growth_figure(rows: list[Row]) -> Figure:
    figure, (axis,) = axes(1)
    photos = np.array([row["photos"] for row in rows], float)
    for key, label in (("seconds", "wall"), ("cpu_seconds", "CPU")):
        seconds = np.array([row[key] for row in rows])
        slope = exponent(rows, key)
        axis.plot(photos, seconds, "o", label=f"{label}: n^{slope:.2f}")
        axis.plot(
            photos, np.exp(np.log(seconds).mean() + slope * (np.log(photos) - np.log(photos).mean())), lw=1
        )
    axis.set(xscale="log", yscale="log", xlabel="photos", ylabel="seconds for the cameras")
    axis.legend()
    return figure


def fit(rows: list[Row]) -> str:
    wall, cpu = exponent(rows, "seconds"), exponent(rows)
    return f"Fit: wall seconds grow as n^{wall:.2f}, CPU seconds as n^{cpu:.2f}."


AGAIN: dict[str, Any] = {"action": "store_true", "help": "measure the chosen rows again"}
STUDY = Study(
    name="sfm",
    about=__doc__,
    cases={"scenes": scenes_bench},
    key=("scene", "setting"),
    order=lambda row: (list(FOLDERS).index(row["scene"]), list(SETTINGS).index(row["setting"])),
    blocks={"table": table, "footer": _rows.footer},
    figures={"sfm": scenes_figure},
    options={
        "scenes": {"nargs": "+", "choices": FOLDERS, "default": list(FOLDERS)},
        "settings": {
            "nargs": "+", "choices": SETTINGS, "default": ["COLMAP defaults", "auto", "lean, all pairs"],
        },
        "train": {"type": float, "default": 20.0, "help": "seconds of training on top of the cameras"},
        "no-train": {"action": "store_true"},
        "again": AGAIN,
    },
)  # fmt: skip
GROWTH = Study(
    name="sfm_growth",
    about=__doc__,
    cases={"growth": growth_bench},
    key=("scene", "setting"),
    order=lambda row: row["photos"],
    blocks={"table": growth_table, "footer": _rows.footer, "fit": fit},
    figures={"sfm_growth": growth_figure},
    options={"counts": {"nargs": "+", "type": int, "default": COUNTS}, "again": AGAIN},
)


def main(argv: list[str]) -> int:
    return (GROWTH if "--growth" in argv else STUDY).main([word for word in argv if word != "--growth"])
