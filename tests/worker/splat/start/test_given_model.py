"""Proves that training starts from a given model, which is compared with the photos first, and that a model which
cannot serve is refused with a reason.

Does not prove how much time a given model saves on real photos.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatmill.schema import Event, LogEvent, TrainOptions
from splatmill_worker import pipeline
from splatmill_worker.errors import Refusal
from splatmill_worker.pipeline import first_gaussians
from splatmill_worker.splat.formats import ply, registry
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.start.points import from_points
from tests.support import still_life

pytestmark = pytest.mark.slow


def run(
    capture: Path, work: Path, cancelled: Callable[[], bool] = lambda: False, **values: object
) -> tuple[pipeline.Outcome, list[Event]]:
    events: list[Event] = []
    asked = TrainOptions.model_validate(
        {"steps": 60, "seed": 1, "max_gaussians": 3000, "lpips": "off", **values}
    )
    return pipeline.run(capture, work, asked, events.append, cancelled), events


def report_of(outcome: pipeline.Outcome) -> dict[str, Any]:
    read: dict[str, Any] = json.loads((outcome.out / "report.json").read_text())
    return read


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture whose poses hold a model of its own, m.ply, made in 150 steps from its points."""
    folder = tmp_path_factory.mktemp("start")
    capture = still_life.posed_capture(folder / "capture")
    scene = still_life.scene()
    first = from_points(torch.from_numpy(scene.points), torch.from_numpy(scene.colors))
    ply.write(capture / "poses" / "m.ply", replace(first, logit_opacities=torch.full((first.count,), 2.0)))
    outcome, _ = run(capture, folder / "work", steps=150, start="m.ply")
    (outcome.out / "model.ply").rename(capture / "poses" / "m.ply")
    return capture


@pytest.fixture(scope="module")
def started(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The report of a short training that starts from the model as it is."""
    return report_of(run(trained, tmp_path_factory.mktemp("started"), start="m.ply", steps=20)[0])


def changed(trained: Path, tmp_path: Path, change: Callable[[Gaussians], Gaussians]) -> Path:
    """The capture with `change` applied to its model."""
    capture = still_life.posed_capture(tmp_path / "capture")
    ply.write(capture / "poses" / "m.ply", change(ply.read(trained / "poses" / "m.ply").gaussians))
    return capture


def test_training_starts_from_the_model_and_improves_it(trained: Path, tmp_path: Path) -> None:
    before = ply.read(trained / "poses" / "m.ply").gaussians
    outcome, events = run(trained, tmp_path, start="m.ply", steps=150)
    report = report_of(outcome)
    assert report["plan"]["initial"] == "model"
    assert f"The given model has {before.count} Gaussians" in report["plan"]["reasons"]["initial"]
    assert report["plan"]["schedule"]["resolution"] == [[0, 1]]
    shown = report["facts"]["start"]["psnr"]
    assert shown > report["facts"]["start"]["one_color"] + 1.0
    assert shown > report["facts"]["start"]["another"] + 3.0
    assert report["result"]["train_psnr"] > shown
    assert report["curve"][0]["gaussians"] <= before.count
    warned = any(event.type == "log" and "given model renders" in event.message for event in events)
    assert warned == (shown <= report["facts"]["start"]["one_color"] + 3.0)


def test_a_model_of_a_lower_degree_is_padded(trained: Path, tmp_path: Path) -> None:
    capture = changed(trained, tmp_path, lambda model: model.padded(0))
    outcome, _ = run(capture, tmp_path / "work", start="m.ply", sh_degree=2, steps=20)
    assert ply.read(outcome.out / "model.ply").gaussians.degree == 2


@pytest.mark.parametrize("suffix", [".spz", ".compressed.ply"])
def test_a_model_of_another_format_starts_as_well(
    trained: Path, started: dict[str, Any], tmp_path: Path, suffix: str
) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    model = registry.read(trained / "poses" / "m.ply").gaussians
    registry.write(capture / "poses" / f"m{suffix}", model)
    outcome, _ = run(capture, tmp_path / "work", start=f"m{suffix}", steps=1)
    shown = report_of(outcome)["facts"]["start"]["psnr"]
    assert shown == pytest.approx(started["facts"]["start"]["psnr"], abs=0.5)


def test_the_degree_of_the_model_is_kept(trained: Path, started: dict[str, Any]) -> None:
    assert ply.read(trained / "poses" / "m.ply").gaussians.degree == 3
    assert started["plan"]["schedule"]["degree"] == 3


def test_a_model_larger_than_allowed_keeps_its_most_opaque_part(trained: Path, tmp_path: Path) -> None:
    outcome, _ = run(trained, tmp_path, start="m.ply", max_gaussians=500, steps=20)
    assert ply.read(outcome.out / "model.ply").gaussians.count <= 500


def test_a_model_that_the_job_cannot_hold_is_reduced_and_the_user_told(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(first_gaussians, "LEAST_ASSESSED", 400)
    count = ply.read(trained / "poses" / "m.ply").gaussians.count
    outcome, events = run(trained, tmp_path, start="m.ply", max_gaussians=500, steps=20)
    assert report_of(outcome)["facts"]["start"]["gaussians"] == 500
    warnings = [event.message for event in events if isinstance(event, LogEvent) and event.level == "warning"]
    assert any(
        f"m.ply has {count:,} Gaussians" in text and "from the 500 most opaque" in text for text in warnings
    )


def test_the_offset_of_a_model_far_from_the_origin_is_added_again(tmp_path: Path) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    path = capture / "poses" / "transforms.json"
    document = json.loads(path.read_text())
    for frame in document["frames"]:
        frame["transform_matrix"][0][3] += 450_000.0
    path.write_text(json.dumps(document))
    first, _ = run(capture, tmp_path / "a", steps=100)
    assert ply.read(first.out / "model.ply").offset[0] == pytest.approx(450_000.0, abs=3.0)
    (capture / "poses" / "m.ply").write_bytes((first.out / "model.ply").read_bytes())
    second, _ = run(capture, tmp_path / "b", start="m.ply", steps=20)
    known = report_of(second)["facts"]["start"]
    assert known["psnr"] == pytest.approx(report_of(first)["result"]["train_psnr"], abs=1.0)


def moved(model: Gaussians) -> Gaussians:
    return model.moved(1.0, torch.tensor([4.0, -3.0, 1.0]))


def emptied(model: Gaussians) -> Gaussians:
    return model.select(torch.zeros(model.count, dtype=torch.bool))


@pytest.mark.parametrize(
    ("change", "says"), [(moved, "not lie in the world"), (emptied, "holds no Gaussian")]
)
def test_a_model_that_shows_something_else_is_refused(
    trained: Path, tmp_path: Path, change: Callable[[Gaussians], Gaussians], says: str
) -> None:
    with pytest.raises(Refusal, match=says) as refused:
        run(changed(trained, tmp_path, change), tmp_path / "work", start="m.ply")
    assert refused.value.code == "start_unusable"


@pytest.mark.parametrize(
    ("content", "says"), [(b"ply\nhello", "could not be read"), (None, "no file 'broken.ply'")]
)
def test_a_file_that_is_not_a_model_is_refused(
    trained: Path, tmp_path: Path, content: bytes | None, says: str
) -> None:
    capture = still_life.posed_capture(tmp_path / "capture")
    if content is not None:
        (capture / "poses" / "broken.ply").write_bytes(content)
    with pytest.raises(Refusal, match=says) as refused:
        run(capture, tmp_path / "work", start="broken.ply")
    assert refused.value.code == "start_unusable"
    assert refused.value.advice


def test_infinite_logits_of_other_tools_are_read_as_opaque(trained: Path, tmp_path: Path) -> None:
    path = tmp_path / "m.ply"
    model = ply.read(trained / "poses" / "m.ply").gaussians
    ply.write(path, model)
    raw = path.read_bytes()
    head, body = raw.split(b"end_header\n", 1)
    table = np.frombuffer(body, "<f4").reshape(model.count, -1).copy()
    table[0, -8] = np.inf  # opacity, before three scales and four of the quaternion
    path.write_bytes(head + b"end_header\n" + table.tobytes())
    read = ply.read(path).gaussians
    assert read.count == model.count
    assert 0.999 < float(torch.sigmoid(read.logit_opacities[0])) <= 1.0
