"""A scene in tiles, from photos to its model: as good as in one piece, the same bytes whoever does the units and
whatever happens to them, and usable where a tile failed.

Does not prove quality on real captures (`worker/bench/tiles.md`), nor SfM (its own tests do).
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatmill.schema import Backend, ModelCameras, Report, TrainOptions
from splatmill_worker import pipeline, synthetic
from splatmill_worker.colmap import pycolmap
from splatmill_worker.kernels.gpu.device import absence
from splatmill_worker.splat.formats import registry
from splatmill_worker.splat.gaussians import concatenate
from splatmill_worker.splat.plan.rates import RateSchedule, boost_of
from splatmill_worker.tiles import coarse_model, command, joined, tile
from splatmill_worker.tiles.folder import DONE, PlanFolder, facts_of
from splatmill_worker.tiles.tile import tile_plan
from tests.support import still_life
from tests.support.made_once import made_once

pytestmark = pytest.mark.slow

OPTIONS = TrainOptions.model_validate(
    {"steps": 200, "seed": 1, "max_gaussians": 3000, "holdout": 5, "tiles": 2}
)


def planned(photos: Path, root: Path, **options: int) -> str:
    """What the command prints that plans the scene with OPTIONS, but for these."""
    asked = {**OPTIONS.model_dump(include={"steps", "seed", "max_gaussians", "holdout", "tiles"}), **options}
    flags = [text for name, value in asked.items() for text in (f"--{name.replace('_', '-')}", str(value))]
    return done("splatmill", "plan", str(photos), "-o", str(root), *flags)


def program(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def done(*arguments: str) -> str:
    process = program(*arguments)
    text, _ = process.communicate(timeout=600)
    assert process.returncode == 0, text
    return text


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plan all of whose units were done by one process after the other."""

    def make(root: Path) -> None:
        planned(still_life.posed_capture(root / "photos"), root)
        done("splatmill", "unit", str(root))

    return made_once(tmp_path_factory, "scene-in-tiles", make)


def copied(whole: Path, to: Path, without: tuple[str, ...] = ()) -> Path:
    """A copy of a plan, without the outputs of some tiles and of what follows from them."""
    shutil.copytree(whole, to, symlinks=True)
    if without:
        (to / "scene").unlink()
        for path in (to / "units").iterdir():
            if path.name.rpartition("-")[0] in (*without, "seam-1", "seam-2", "scene"):
                shutil.rmtree(path)
    return to


def model_of(root: Path) -> bytes:
    return (root / "scene" / "model.ply").read_bytes()


def test_the_scene_is_as_good_as_in_one_piece(whole: Path, tmp_path: Path) -> None:
    in_one_piece = OPTIONS.model_copy(update={"tiles": None})
    outcome = pipeline.run(whole / "photos", tmp_path, in_one_piece, lambda event: None, lambda: False)
    assert outcome.trained is not None
    assert outcome.trained.held_out is not None
    ended = PlanFolder.open(whole).ended()
    facts = {
        name: json.loads((end.path / "done.json").read_text())
        for name, end in ended.items()
        if end.path is not None
    }
    assert facts["scene"]["psnr"] > outcome.trained.held_out.psnr - 0.3
    assert facts["scene"]["psnr"] > facts["coarse"]["psnr"]
    assert facts["scene"]["failed"] == []
    seams = facts["scene"]["seams"]
    assert 0.0 < seams["share"] < 1.0
    assert seams["seams"] > seams["coarse_seams"] - 0.2
    assert facts["scene"]["gaussians"] == sum(facts[f"seam-{number}"]["gaussians"] for number in (1, 2))
    assert min(facts[f"seam-{number}"]["gaussians"] for number in (1, 2)) > 200


def test_a_tile_goes_on_where_the_coarse_model_stopped(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = PlanFolder.open(whole).ended()["coarse"].path
    assert path is not None
    coarse = coarse_model.read(path)
    plan = tile_plan(coarse, free=500, photos=11)
    assert coarse.steps == 100
    assert plan.schedule.earlier_visits == coarse.steps / len(coarse.views)
    assert plan.schedule.reduced_until == 0
    last = tile_plan(coarse, free=500, photos=11, last=True)
    assert (plan.schedule.budget.steps, last.schedule.budget.steps) == (80, 20)
    assert (last.densify, last.max_gaussians) == (False, 500)
    assert last.schedule.earlier_visits == coarse.steps / len(coarse.views) + 80 / 11
    first_ends, last_begins = (
        RateSchedule(1.0, each.schedule.annealing).at(progress)
        for each, progress in ((plan, 1.0), (last, 0.0))
    )
    assert first_ends == last_begins
    assert (plan.schedule.annealing.begin, last.schedule.annealing.end) == (0.0, 1.0)
    doubled = replace(coarse, steps=4000)  # the course of a run that was laid out for fewer steps
    for part in (tile_plan(doubled, 500, 11, last=last).schedule for last in (False, True)):
        assert part.budget.steps is not None
        assert part.annealing.boost == boost_of(4000) < boost_of(part.budget.steps)
    often = tile_plan(replace(coarse, steps=200 * len(coarse.views)), 500, len(coarse.views))
    assert often.schedule.annealing.begin == pytest.approx(1 - 100 / 400), "all but the last 100 of 400 steps"
    assert often.schedule.annealing.end == pytest.approx(0.75 + 0.25 * 0.8)
    photos = len(coarse.views)
    each = round(4000 * (photos // 3) / photos)
    third = [tile_plan(doubled, 500, photos // 3, last=last).schedule.budget.steps for last in (False, True)]
    assert third == [round(0.8 * each), each - round(0.8 * each)], "as often on each photo"
    late = replace(plan.schedule, dropout=0.2, earlier_visits=150.0)
    assert late.left_out(0.0) == pytest.approx(0.1)
    assert late.left_out(50.0) == pytest.approx(0.2)
    monkeypatch.setattr(tile, "COARSE_SHARE", 0.25)  # the tiles take what the coarse training leaves
    budgets = [tile_plan(coarse, 500, 11, last=last).schedule.budget.steps for last in (False, True)]
    assert budgets == [240, 60]


def test_a_tile_adds_gaussians_for_as_long_as_one_piece_or_as_a_limit_stopped_the_coarse_training(
    whole: Path, tmp_path: Path
) -> None:
    path = PlanFolder.open(whole).ended()["coarse"].path
    assert path is not None
    coarse = coarse_model.read(path)
    for limited in (True, False):
        replace(coarse, limited=limited).write(tmp_path)
        assert coarse_model.read(tmp_path).limited is limited
    uneven = replace(coarse.plan, schedule=replace(coarse.plan.schedule, densify_until=0.5))
    for of_one_piece, limited, until in (
        (coarse.plan, True, 0.7 / 0.8),
        (coarse.plan, False, (0.7 - 0.5) / (0.5 * 0.8)),
        (uneven, True, 0.5 / 0.8),
        (uneven, False, 0.0),
    ):
        growing = tile_plan(replace(coarse, plan=of_one_piece, limited=limited), 500, 11)
        assert growing.densify
        assert growing.max_gaussians == pytest.approx(3000 * 500 / coarse.gaussians.count, abs=1)
        assert growing.schedule.densify_until == pytest.approx(until)
        last = tile_plan(replace(coarse, limited=limited), 500, 11, last=True)
        assert (last.densify, last.max_gaussians) == (False, 500)
    asked = replace(coarse, plan=replace(coarse.plan, densify=False, forced=("densify",)))
    assert not tile_plan(asked, 500, 11).densify


def test_a_tile_sets_no_photo_aside_that_the_coarse_model_was_trained_on(whole: Path) -> None:
    path = PlanFolder.open(whole).ended()["coarse"].path
    assert path is not None
    coarse = coarse_model.read(path)
    watched = replace(coarse.plan, validation=2, stops_when_flat=True, target_psnr=30.0)
    plan = tile_plan(replace(coarse, plan=watched, steps=70), free=500, photos=11)
    assert (plan.validation, plan.stops_when_flat, plan.target_psnr) == (None, False, None)
    assert plan.schedule.budget.steps == plan.schedule.expected_steps == 56


def test_no_tile_trains_what_stands_far_behind_a_large_scene(whole: Path, tmp_path: Path) -> None:
    root = copied(whole, tmp_path / "plan", ("tile-1", "tile-2"))
    path = PlanFolder.open(root).ended()["coarse"].path
    assert path is not None
    coarse = coarse_model.read(path)
    assert not coarse.far.any(), "a photo has half of the scene in view"
    shell = coarse.gaussians.select(torch.arange(coarse.gaussians.count) < 20)
    shell = replace(shell, means=shell.means + 1000.0)
    schedule = replace(coarse.plan.schedule, in_view=0.2, decay_within=500.0)
    large = replace(
        coarse,
        gaussians=concatenate(coarse.gaussians, shell),
        plan=replace(coarse.plan, schedule=schedule),
    )
    far = int(large.far.sum())
    assert far == 20
    assert large.far[-20:].all()
    anew = tmp_path / "coarse"
    anew.mkdir()
    large.write(anew)
    shutil.copyfile(path / DONE, anew / DONE)
    shutil.rmtree(path)
    anew.rename(path)
    done("splatmill", "unit", str(root))
    ended = PlanFolder.open(root).ended()
    outputs = {name: end.path for name, end in ended.items() if end.path is not None}
    trained = [facts_of(outputs[f"seam-{number}"])["gaussians"] for number in (1, 2)]
    assert facts_of(outputs["scene"])["gaussians"] == sum(trained) + far
    whole_scene = joined.joined(large, [outputs["seam-1"], outputs["seam-2"]])
    left = large.gaussians.select(large.far)
    for name, values in left.parameters().items():
        assert torch.equal(whole_scene.parameters()[name][-far:], values)
    assert joined.joined(large, [None, None]).count == large.gaussians.count


def test_the_scene_has_the_files_of_a_training(whole: Path) -> None:
    out = whole / "scene"
    report = json.loads((out / "report.json").read_text())
    checked = Report.model_validate(report)
    assert checked.curve[-1].psnr == pytest.approx(report["result"]["psnr"])
    assert [row.step for row in checked.curve] == sorted(row.step for row in checked.curve)
    assert report["plan"]["max_gaussians"] == OPTIONS.max_gaussians
    assert "2 tiles" in report["plan"]["reasons"]["max_gaussians"]
    assert report["result"]["gaussians"] == registry.read(out / "model.ply").gaussians.count
    cameras = ModelCameras.model_validate_json((out / "cameras.json").read_text())
    assert len(cameras.cameras) == still_life.COUNT
    assert (out / "report.html").stat().st_size > 10_000
    assert (out / "cameras.zip").is_file()


def test_the_bytes_are_the_same_whoever_does_the_units_and_one_of_them_is_killed(
    whole: Path, tmp_path: Path
) -> None:
    root = copied(whole, tmp_path / "plan", without=("tile-1", "tile-2"))
    killed = program("splatmill", "unit", str(root), "tile-1")
    claims = root / "units"
    end = time.monotonic() + 100
    while not list(claims.glob("tile-1*.claim")) and time.monotonic() < end:
        time.sleep(0.05)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert list(claims.glob("tile-1*.claim")), "the unit was not done when its process was killed"
    both = [program("splatmill", "unit", str(root)) for _ in range(2)]
    texts = [process.communicate(timeout=600)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], texts
    assert model_of(root) == model_of(whole)
    assert len(list(claims.iterdir())) == len(PlanFolder.open(root).plan.units), "nothing but outputs is left"


def test_a_unit_that_is_stopped_is_free_and_its_partners_are_kept(whole: Path, tmp_path: Path) -> None:
    root = copied(whole, tmp_path / "plan", without=("tile-2",))
    process = program("splatmill", "unit", str(root))
    end = time.monotonic() + 100
    while not list((root / "units").glob("tile-2*.claim")) and time.monotonic() < end:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    text, _ = process.communicate(timeout=100)
    assert process.returncode == 130, text
    assert "kept" in text
    folder = PlanFolder.open(root)
    assert folder.plan.ready(folder.states()) == ["tile-2"]
    assert folder.running("tile-2") is None


def test_a_failed_tile_leaves_a_scene_with_the_coarse_model_in_its_place(whole: Path, tmp_path: Path) -> None:
    root = copied(whole, tmp_path / "plan", without=("tile-1",))
    folder = PlanFolder.open(root)
    with folder.claimed("tile-1") as run:
        run.fail("Training diverged.", "Try another seed.")
    text = done("splatmill", "unit", str(root))
    assert text.startswith("seam-1: begins\n"), text
    assert "tile-1     failed    Training diverged. Try another seed." in text
    report = json.loads((root / "scene" / "report.json").read_text())
    (warning,) = (each for each in report["warnings"] if "Tile 1 of 2" in each)
    assert "coarse model" in warning
    assert model_of(root) != model_of(whole)


def test_another_option_repeats_only_what_depends_on_it_and_other_photos_all(
    whole: Path, tmp_path: Path
) -> None:
    root = copied(whole, tmp_path / "plan")
    assert "done already: photos, cameras\n" in planned(whole / "photos", root, steps=60)
    again = PlanFolder.open(root)
    assert again.states() == dict.fromkeys(again.plan.camera_names, "done")
    kept = "photos, cameras, coarse, tile-1, tile-2, seam-1, seam-2, scene"
    assert f"done already: {kept}\n" in planned(whole / "photos", root)
    (root / "scene").unlink()
    (root / "scene").symlink_to("units")  # as another plan may have left it
    done("splatmill", "unit", str(root))
    assert model_of(root) == model_of(whole)
    fewer = tmp_path / "fewer"
    shutil.copytree(whole / "photos", fewer)
    (fewer / "images" / "00.png").unlink()
    assert "done already" not in planned(fewer, root)
    assert not (PlanFolder.open(root).capture / "images" / "00.png").exists()
    # Refused options leave the plan that there is, and nothing of the photos.
    before = sorted(path.name for path in root.iterdir())
    process = program("splatmill", "plan", str(whole / "photos"), "-o", str(root), "--time-budget", "60")
    text, _ = process.communicate(timeout=100)
    assert process.returncode == 2, text  # as for every option that is not valid
    assert sorted(path.name for path in root.iterdir()) == before
    assert "done already" not in planned(fewer, root)


def test_units_are_listed(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = copied(whole, tmp_path / "plan", without=("tile-1",))
    with PlanFolder.open(root).claimed("tile-1"):
        assert command.list_units(root, as_json=True) == 0
        rows = {row["unit"]: row for row in json.loads(capsys.readouterr().out)}
    assert {name: row["state"] for name, row in rows.items()} == {
        **dict.fromkeys(
            ("features-1", "features-2", "pairs", "matches-1", "matches-2", "mapping-1", "mapping-2"), "left out"
        ),
        "photos": "done", "cameras": "done", "coarse": "done", "tile-1": "running", "tile-2": "done",
        "seam-1": "waiting", "seam-2": "waiting", "scene": "waiting",
    }  # fmt: skip
    assert rows["tile-1"]["why"] == f"{os.uname().nodename}, process {os.getpid()}"
    assert rows["seam-2"]["why"] == "needs tile-1"
    assert rows["scene"]["why"] == "needs tile-1, seam-1, seam-2"
    assert rows["coarse"]["psnr"] > 15
    assert command.do_units(root, ["scene"]) == command.REFUSED
    assert "scene needs tile-1, seam-1, seam-2 first" in capsys.readouterr().err
    assert command.do_units(root, ["tile-9"]) == command.REFUSED
    assert "Its units are photos, features-1" in capsys.readouterr().err


def test_a_capture_without_cameras_fails_once_and_says_why(tmp_path: Path) -> None:
    (tmp_path / "capture" / "images").mkdir(parents=True)
    (tmp_path / "capture" / "images" / "a.txt").write_text("no photo")
    assert command.make_plan(tmp_path, tmp_path / "capture", OPTIONS.model_dump_json()) == 0
    process = program("splatmill", "unit", str(tmp_path))
    text, _ = process.communicate(timeout=100)
    assert process.returncode == command.FAILED
    assert "cameras    failed" in text
    assert "coarse     waiting   needs cameras" in text


def test_masks_that_were_made_of_photos_are_read_by_later_units(tmp_path: Path) -> None:
    """With a logo in each photo, whose mask lies in the output of the first unit, which decoders must be let read."""
    root, capture = tmp_path / "plan", tmp_path / "capture"
    synthetic.capture(capture / "images", 16, 320, 240, samples=1)
    logo = np.random.default_rng(0).integers(0, 2, (3, 24)).repeat(6, 0).repeat(6, 1)
    for path in sorted((capture / "images").iterdir()):
        pixels = np.asarray(Image.open(path)).copy()
        pixels[8:26, 10:154][logo == 1] = 250
        Image.fromarray(pixels).save(path, quality=95)
    assert command.make_plan(root, capture, OPTIONS.model_dump_json()) == 0
    for unit in ("photos", "features-1"):
        assert command.do_units(root, [unit]) == 0
    outputs = {name: ended.path for name, ended in PlanFolder.open(root).ended().items()}
    assert list(outputs) == ["photos", "features-1"]
    photos, features = outputs["photos"], outputs["features-1"]
    assert photos is not None
    assert features is not None
    assert list((photos / "overlays").iterdir())
    (path,) = features.rglob("database.db")
    with closing(pycolmap.Database.open(path)) as database:
        points = np.concatenate(
            [database.read_keypoints(image.image_id) for image in database.read_all_images()]
        )
    on_logo = (points[:, 0] > 12) & (points[:, 0] < 150) & (points[:, 1] > 10) & (points[:, 1] < 24)
    assert len(points) > 300
    assert not on_logo.any()


def test_a_unit_that_ends_its_process_is_given_up_and_the_others_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By a program in place of Python that publishes units at once, and ends with the second tile."""
    root, fake = tmp_path / "plan", tmp_path / "python"
    capture = still_life.posed_capture(tmp_path / "capture")
    assert command.make_plan(root, capture, OPTIONS.model_dump_json()) == 0
    fake.write_text(
        f"""#!{sys.executable}
import os, signal, sys
from pathlib import Path
from splatmill_worker.tiles.folder import PlanFolder
at = sys.argv.index("--begun")
begun, root, names = int(sys.argv[at + 1]), Path(sys.argv[at + 3]), sys.argv[at + 4:]
for name in names:
    with PlanFolder.open(root).claimed(name) as run:
        os.write(begun, f"{{name}}\\n".encode())
        with open(root / "log", "a") as log:
            log.write(f"{{name}} ")
        if name == "tile-2":
            os.kill(os.getpid(), signal.SIGKILL)
        run.out.mkdir()
        run.publish({{"photos": 0}})
""",
        "utf-8",
    )
    fake.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(fake))
    assert command.do_units(root, []) == 0
    assert PlanFolder.open(root).states() == {
        unit.name: "failed" if unit.name == "tile-2" else "done" for unit in PlanFolder.open(root).plan.units
    }
    assert (root / "log").read_text().split() == [
        *("photos", "features-1", "features-2", "pairs", "matches-1", "matches-2", "mapping-1", "mapping-2"),
        *("cameras", "coarse"),
        *("tile-1", "tile-2", "tile-2", "tile-2", "seam-1", "seam-2", "scene"),
    ]
    assert "tile-2 was tried 3 times, and its process was killed" in capsys.readouterr().out


def test_a_program_whose_output_nobody_reads_ends(tmp_path: Path) -> None:
    root = tmp_path / "plan"
    capture = still_life.posed_capture(tmp_path / "capture")
    assert command.make_plan(root, capture, OPTIONS.model_dump_json()) == 0
    process = program("splatmill_worker", "unit", str(root))
    assert process.stdout is not None
    process.stdout.close()
    assert process.wait(timeout=100) == command.UNWRITABLE
    assert PlanFolder.open(root).states() == {}


def test_photos_that_are_links_are_planned(whole: Path, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    (photos / "images").mkdir(parents=True)
    shutil.copytree(whole / "photos" / "poses", photos / "poses")
    for path in (whole / "photos" / "images").iterdir():
        (photos / "images" / path.name).symlink_to(os.path.relpath(path, photos / "images"))
    planned(photos, tmp_path / "plan")
    capture = PlanFolder.open(tmp_path / "plan").capture
    assert capture.name == PlanFolder.open(whole).capture.name
    assert not any(path.is_symlink() for path in capture.rglob("*"))


def test_an_attempt_that_another_machine_may_do_is_no_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = OPTIONS.model_copy(update={"backend": Backend.gpu})
    capture = still_life.posed_capture(tmp_path / "capture")
    assert command.make_plan(tmp_path, capture, asked.model_dump_json()) == 0
    for unit in PlanFolder.open(tmp_path).plan.camera_names:
        assert command.do_units(tmp_path, [unit]) == 0
    lacking = absence() is not None
    assert command.do_units(tmp_path, ["coarse"]) == (command.BROKEN if lacking else 0)
    assert ("gpu" in capsys.readouterr().err) == lacking
    assert PlanFolder.open(tmp_path).plan.ready(PlanFolder.open(tmp_path).states())[0] == (
        "coarse" if lacking else "tile-1"
    )


def test_a_failure_is_forgotten_with_a_new_plan(tmp_path: Path) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    assert command.make_plan(tmp_path, capture, OPTIONS.model_dump_json()) == 0
    with PlanFolder.open(tmp_path).claimed("cameras") as run:
        run.fail("No photo is left.", "")
    assert PlanFolder.open(tmp_path).states() == {"cameras": "failed"}
    again = still_life.posed_capture(tmp_path / "again")
    assert command.make_plan(tmp_path, again, OPTIONS.model_dump_json()) == 0
    assert PlanFolder.open(tmp_path).states() == {}
    assert not again.exists()
