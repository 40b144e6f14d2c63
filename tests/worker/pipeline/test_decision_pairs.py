"""Proves that every two decisions of a plan run together: each level of each decision beside each level of each other.

The decisions are read from TrainOptions and Plan, so that a new one is among them. On a tiny posed capture, with few
steps. Does not prove that any of them improves a model, nor what three decisions do together.
"""

from __future__ import annotations

import json
import shutil
import weakref
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import splatmill.schema.options
from splatmill.schema import Event, Report, Switch, TrainOptions
from splatmill_worker import pipeline
from splatmill_worker.errors import Refusal
from splatmill_worker.images.load import Photo, load_views
from splatmill_worker.images.pixel_files import PixelFiles
from splatmill_worker.kernels.records import Rates
from splatmill_worker.pipeline import photos
from splatmill_worker.scene import Lens, PointViews, Scene, View
from splatmill_worker.sfm.posed.written import model_of
from splatmill_worker.splat.engine.protocol import StepResult
from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.plan import schedule
from splatmill_worker.splat.train.run import TrainingRun
from splatmill_worker.synthetic import orbit, photograph, still_life
from tests.support.plans import decisions
from tests.support.plans.pairwise import covering, pairs

WIDTH, HEIGHT, COUNT = decisions.LONGEST, 24, 14

FACTORS = decisions.factors()
LEVELS = {name: list(levels) for name, levels in FACTORS.items()}
REFUSED = decisions.refused(FACTORS)
ROWS = covering(LEVELS, REFUSED)
REFUSED_PAIRS = sorted(sorted(pair) for pair in REFUSED)


@cache
def pictures() -> tuple[tuple[Any, np.ndarray, np.ndarray], ...]:
    life = still_life(0)
    return tuple((camera, *photograph(life, camera, samples=1)) for camera in orbit(COUNT, WIDTH, HEIGHT))


def scene(lens: bool, points: bool) -> Scene:
    """The still life, its points from the depths of the photos, each seen by the photos that it projects into."""
    random = np.random.default_rng(0)
    views, places, colors = [], [], []
    for index, (camera, rgb, depth) in enumerate(pictures()):
        bent = Lens("SIMPLE_RADIAL", (camera.fx, camera.cx, camera.cy, 0.05), WIDTH, HEIGHT) if lens else None
        views.append(View(f"{index:02d}.png", camera, Path(f"{index:02d}.png"), lens=bent))
        rows, columns = random.integers(HEIGHT, size=20), random.integers(WIDTH, size=20)
        near = depth[rows, columns] < 15.0
        rows, columns = rows[near], columns[near]
        places.append(camera.unproject(columns + 0.5, rows + 0.5, depth[rows, columns]))
        colors.append(rgb[rows, columns])
    if not points:
        return Scene(tuple(views), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "colmap")
    where = np.concatenate(places)
    observers = [
        [i for i, view in enumerate(views) if view.camera.project(place[None]).inside[0]] for place in where
    ]
    tracks = PointViews(np.cumsum([0, *map(len, observers)]), np.concatenate(observers).astype(np.int32))
    errors = np.full(len(where), 0.5)
    return Scene(
        tuple(views), where, np.concatenate(colors), "colmap", point_errors=errors, point_views=tracks
    )


def capture(folder: Path, kinds: tuple[str, ...]) -> Path:
    """A capture on disk. Without points, photos are transparent: around the middle of the still life, whose outlines
    bound a hull, or behind the table, which frames cut, so that training starts at random places.
    """
    transparent = "random" in kinds or "hull" in kinds
    for name in ("images", "masks", "poses"):
        (folder / name).mkdir(parents=True)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for index, (camera, rgb, depth) in enumerate(pictures()):
        # Every second photo is darker, so that there is light to compare.
        pixels = (rgb * (0.7 if index % 2 else 1.0)).astype(np.uint8)
        if transparent:
            places = camera.unproject(columns.ravel(), rows.ravel(), depth.ravel()).reshape(HEIGHT, WIDTH, 3)
            near = np.hypot(places[..., 0], places[..., 1]) < 1.35
            alpha = np.where(near if "hull" in kinds else depth < 6.5, 255, 0).astype(np.uint8)
            pixels = np.dstack([pixels, alpha])
        Image.fromarray(pixels).save(folder / "images" / f"{index:02d}.png")
        if "masked" in kinds:
            mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
            mask[:, : 1 + index // 4] = 0
            Image.fromarray(mask).save(folder / "masks" / f"{index:02d}.png")
    world = scene("distorted" in kinds, not transparent)
    model_of(list(world.views), world.points, world).write_binary(str(folder / "poses"))
    if "model" in kinds:
        asked = TrainOptions(steps=60, seed=1, lpips=Switch.off)
        outcome = pipeline.run(folder, folder / "first", asked, lambda _: None, lambda: False)
        shutil.move(outcome.out / "model.ply", folder / "poses" / "first.ply")
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pairs")


def run(
    folder: Path, work: Path, row: dict[str, str]
) -> tuple[pipeline.Outcome, list[Event], dict[str, Any]]:
    """Train with the decisions of `row`; returns the plan's fields that were forced, too."""
    forced = [FACTORS[name][level] for name, level in row.items()]
    kinds = tuple(kind for each in forced for kind in each.capture) or ("points",)
    place = folder / "-".join(kinds)
    if not place.exists():
        capture(place, kinds)
    asked = {name: value for each in forced for name, value in each.options.items()}
    if "model" in kinds:
        asked["start"] = "first.ply"
    changes = decisions.ALWAYS | {name: value for each in forced for name, value in each.plan.items()}
    if "end" not in row:
        asked["steps"] = decisions.STEPS
    asked.setdefault("lpips", "off")
    events: list[Event] = []
    outcome = pipeline.run(
        place,
        work,
        TrainOptions.model_validate(asked),
        events.append,
        lambda: False,
        revise=lambda plan: decisions.revised(plan, changes),
    )
    return outcome, events, changes


def test_the_rows_hold_every_pair() -> None:
    held = {pair for row in ROWS for pair in pairs({name: [level] for name, level in row.items()})}
    assert held == pairs(LEVELS) - REFUSED


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS, ids=range(len(ROWS)))
def test_every_two_decisions_run_together(
    folder: Path, tmp_path: Path, row: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(schedule, "MANY_VISITS", 0.2)  # so that a few steps reach the dropout
    outcome, events, changes = run(folder, tmp_path, row)
    assert outcome.ended == "succeeded"
    plan = next(event.plan for event in events if event.type == "plan")
    switches = ("exposure", "far_shell", "gaps", "pose_refinement", "densify", "antialias", "cluster_culling")
    for name in switches:
        assert plan.get(name, False) is (row[name] == "on"), name
    assert plan["initial"] == row["initial"]
    assert plan["image_size"] == changes["image_size"]
    written = json.loads((outcome.out / "report.json").read_text())
    report = Report.model_validate(written)
    assert report.curve[-1].step == written["result"]["steps"] == decisions.STEPS
    assert written["result"]["failure"] is None
    assert (report.curve[-1].psnr is None) is (row["holdout"] == "0")
    assert report.curve[-1].train_psnr is not None
    assert report.curve[-1].train_psnr > 5.0
    gaussians = ply.read(outcome.out / "model.ply").gaussians
    assert bool(gaussians.finite().all())
    assert 1 <= gaussians.count <= plan["max_gaussians"]


@pytest.mark.slow
@pytest.mark.parametrize("pair", REFUSED_PAIRS, ids=lambda pair: "-".join(pair[0] + pair[1]))
def test_what_cannot_stand_together_is_refused(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pair: list[tuple[str, str]]
) -> None:
    # The options that auto stands for on some machine are refused by the run, though not before it.
    monkeypatch.setattr(splatmill.schema.options, "check_conflicts", lambda options: None)
    with pytest.raises(Refusal) as refused:
        run(folder, tmp_path, dict(pair))
    assert refused.value.code == "option_out_of_range"


@pytest.mark.slow
@pytest.mark.parametrize(
    "row",
    [
        {"masks": "some", "exposure": "on"},
        {"undistortion": "some", "exposure": "on"},
        {"initial": "hull"},
    ],
    ids=lambda row: next(iter(row)),
)
def test_photos_in_files_train_the_same_model(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, row: dict[str, str]
) -> None:
    """Reduced photos at first, then whole ones, and of all but transparent ones the light is evened: the model, the
    loss of each step and the scores are the same to the bit.
    """
    row = row | {
        "schedule.resolution": "reduced",
        "schedule.dropout": "some",
        "holdout": "8",
        "backend": "cpu",
    }
    runs = []
    step = TrainingRun._step
    for place, fits in (("memory", True), ("files", False)):
        losses: list[float] = []

        def watched(self: TrainingRun, index: int, rates: Rates, losses: list[float] = losses) -> StepResult:
            result = step(self, index, rates)
            losses.append(result.loss)
            return result

        monkeypatch.setattr(TrainingRun, "_step", watched)
        monkeypatch.setattr(photos, "fit_in_memory", lambda photo_bytes, memory, fits=fits: fits)
        outcome, events, _ = run(folder, tmp_path / place, row)
        plan = next(event.plan for event in events if event.type == "plan")
        report = json.loads((outcome.out / "report.json").read_text())
        assert ("photos_on_disk" in plan["reasons"]) is not fits
        assert report["facts"]["photos_on_disk"] is not fits
        assert report["facts"]["photo_bytes"] == 4 * COUNT * WIDTH * HEIGHT
        scores = [(point["step"], point["psnr"], point["train_psnr"]) for point in report["curve"]]
        runs.append(((outcome.out / "model.ply").read_bytes(), losses, scores))
        assert len(losses) == decisions.STEPS
    assert runs[0] == runs[1]


@pytest.mark.slow
def test_photos_are_held_at_one_size_at_a_time(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photos that are loaded again, smaller, are not kept at their first size meanwhile; even where light is evened."""
    alive: list[weakref.ref[Any]] = []
    counts = []

    def watched(views: Any, size: int, *, files: PixelFiles | None, told: Any) -> list[Photo]:
        counts.append((size, sum(each() is not None for each in alive)))
        loaded = load_views(views, size, files=files, told=told)
        photos = [replace(photo, rgb=photo.rgb.copy()) for photo in loaded]
        alive.extend(weakref.ref(photo.rgb) for photo in photos)
        return photos

    monkeypatch.setattr(photos, "load_views", watched)
    run(folder, tmp_path, {"image_size": "halved", "exposure": "on"})
    (_, first), (_, second), (size, third), (_, fourth) = counts
    assert (first, second) == (0, COUNT - 2)
    assert size == decisions.LONGEST // 2
    assert (third, fourth) == (0, COUNT - 2)
