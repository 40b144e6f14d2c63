"""What a job shows while it runs: scenes in the model's coordinates, cameras with their photos, and nothing unasked.

Does not prove how it reaches a browser (tests/browser), nor what it costs (`splatmill bench live`).
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from splatmill.schema import CamerasEvent, Event, ModelCameras, Placement, TrainOptions
from splatmill_worker import pipeline, sfm, synthetic
from splatmill_worker.pipeline import live
from splatmill_worker.scene import Camera, Normalization, Scene, View
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.report.export import ExportWorld
from tests.support import still_life
from tests.worker.audience import Audience, snapshot


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looks follow each other without a pause, so that short runs have some."""
    monkeypatch.setattr(live, "INTERVAL", 0.0)
    monkeypatch.setattr(live, "SHARE", 1e9)


def run(tmp_path: Path, audience: Audience, **options: object) -> tuple[pipeline.Outcome, list[Event]]:
    capture = still_life.posed_capture(tmp_path / "capture")
    events: list[Event] = []
    asked = TrainOptions.model_validate(
        {"steps": 60, "seed": 1, "gaps": "off", "far_shell": "off", **options}
    )
    outcome = pipeline.run(
        capture, tmp_path / "work", asked, events.append, lambda: False, onlookers=audience
    )
    return outcome, events


@pytest.mark.slow
def test_snapshots_are_the_scene_in_the_coordinates_of_the_model(tmp_path: Path) -> None:
    audience = Audience()
    outcome, _ = run(tmp_path, audience)
    assert len(audience.shown) > 5
    ply, event = audience.shown[-1]
    assert event.bytes == len(ply)
    assert 0 < event.step <= 60
    shown = snapshot(ply, tmp_path)
    model = pipeline_model(outcome)
    assert shown.degree == 0
    assert abs(shown.count - model.count) < 0.2 * model.count
    # Steps after the snapshot move Gaussians by little of the scene's size, and the still life has no symmetry.
    spread = model.means.std(dim=0)
    assert torch.allclose(shown.means.mean(dim=0), model.means.mean(dim=0), atol=0.05 * float(spread.max()))
    assert torch.allclose(shown.means.std(dim=0), spread, rtol=0.1)
    seconds = json.loads((outcome.out / "report.json").read_text())["seconds"]
    assert seconds["live"] > 0


def pipeline_model(outcome: pipeline.Outcome) -> Gaussians:
    from splatmill_worker.splat.formats import ply

    return ply.read(outcome.out / "model.ply").gaussians


@pytest.mark.slow
def test_a_job_that_nobody_looks_at_shows_its_cameras_alone(tmp_path: Path) -> None:
    audience = Audience(there=False)
    outcome, events = run(tmp_path, audience)
    assert audience.shown == []
    assert "live" not in json.loads((outcome.out / "report.json").read_text())["seconds"]
    placed = [event for event in events if isinstance(event, CamerasEvent)]
    assert [(event.final, event.cameras) for event in placed] == [(True, still_life.COUNT)]
    document = Placement.model_validate_json((tmp_path / "work" / placed[0].path).read_text())
    exported = ModelCameras.model_validate_json((outcome.out / "cameras.json").read_text()).cameras
    poses = {row.name: (row.split, row.camera.camera_to_world) for row in exported}
    for camera in document.cameras:
        split, pose = poses[camera.name]
        assert camera.split == split
        assert np.allclose(camera.camera.camera_to_world, pose, atol=1e-6)


def test_a_placement_has_reasons_an_even_choice_of_points_and_the_offset_taken_off() -> None:
    base = still_life.scene()
    far = np.array([4e5, 5e6, 30.0])
    views = tuple(
        View(view.name, view.camera.moved_to(view.camera.center + far), view.image) for view in base.views
    )
    points = np.repeat(base.points, 1 + live.MOST_POINTS // len(base.points), axis=0) + far
    points[0] = np.nan
    colors = np.repeat(base.colors, len(points) // len(base.colors), axis=0)
    left_out = (("dark.jpg", "it matches no other photo"),)
    scene = Scene(views, points, colors, "transforms", left_out=left_out)
    world = ExportWorld.of(Normalization.of(scene), scene)
    assert world.offset.any()
    document = live.placement_of(scene, world, ["08.png"])
    assert len(document.points) == len(document.colors) <= live.MOST_POINTS < document.points_total
    assert np.abs(np.array(document.points)).max() < 1e3
    assert [camera.name for camera in document.cameras if camera.split == "test"] == ["08.png"]
    assert [(photo.name, photo.why) for photo in document.unused] == list(left_out)
    assert Placement.model_validate_json(document.model_dump_json()) == document


def test_a_large_scene_is_cut_to_the_gaussians_that_cover_most() -> None:
    def gaussians(log_scales: list[float], logits: list[float]) -> Gaussians:
        n = len(logits)
        return Gaussians(
            means=torch.arange(3.0 * n).reshape(n, 3),
            log_scales=torch.tensor(log_scales)[:, None].expand(n, 3).clone(),
            quats=torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4).clone(),
            logit_opacities=torch.tensor(logits),
            sh=torch.zeros(n, 1, 3),
        )

    scene = gaussians([0.0, -3.0, 0.0, -1.0, float("nan")], [2.0, 2.0, -6.0, 3.0, 9.0])
    kept = live.most_covering(scene, 2)
    assert kept.means[:, 0].tolist() == [0.0, 9.0], "opaque and large ones, in their order"
    assert live.most_covering(scene, 4).count == 3


def test_looks_are_rare_and_take_a_small_share_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    audience = Audience()
    looks = live.Looks(audience)
    assert looks.is_due()
    with looks.one():
        assert looks.seconds == 0.0
    assert not looks.is_due()
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + live.INTERVAL + 0.1)
    assert looks.is_due()
    audience.there = False
    assert not looks.is_due()
    audience.there = True
    monkeypatch.setattr(time, "perf_counter", iter([10.0, 11.0]).__next__)
    with looks.one():
        pass
    monkeypatch.setattr(time, "monotonic", lambda: now + live.INTERVAL + 0.1 + 49.0)
    assert not looks.is_due(), "one second of looking is followed by fifty of work"
    monkeypatch.setattr(time, "monotonic", lambda: now + live.INTERVAL + 0.1 + 50.5)
    assert looks.is_due()


@pytest.mark.slow
def test_cameras_are_shown_while_the_mapper_places_them(tmp_path: Path) -> None:
    synthetic.capture(tmp_path / "images", 12, 320, 240, samples=1)
    events: list[Event] = []
    documents: list[Placement] = []

    def emit(event: Event) -> None:
        events.append(event)
        assert isinstance(event, CamerasEvent)
        documents.append(Placement.model_validate_json((tmp_path / event.path).read_text()))

    looks = live.Looks(Audience())
    scene = sfm.reconstruct(
        tmp_path / "images",
        None,
        tmp_path / "work",
        sfm.SfmOptions(effort="lean", mapper="incremental", stereo=False),
        lambda stage, done, total, note: None,
        lambda: False,
        live.LiveCameras(looks, emit, tmp_path),
    )
    counts = [len(document.cameras) for document in documents]
    assert counts[0] <= 3
    assert max(counts) >= len(scene.views) - 1 >= 5
    assert len(set(counts)) >= 4
    assert all(not document.final and document.points_total > 20 for document in documents)
    last = max(documents, key=lambda document: len(document.cameras))
    ours = {camera.name: centre(camera.camera.camera_to_world) for camera in last.cameras}
    final = {view.name: view.camera for view in scene.views}
    assert spread_like(ours, final)
    assert looks.seconds > 0


def centre(pose: object) -> np.ndarray:
    return np.array(pose)[:3, 3]


def spread_like(ours: dict[str, np.ndarray], final: dict[str, Camera]) -> bool:
    """Whether distances between cameras agree with those of the final model, up to one scale."""
    names = sorted(ours.keys() & final.keys())
    a = np.array([ours[name] for name in names])
    b = np.array([final[name].center for name in names])
    one, other = (np.linalg.norm(x[:, None] - x[None], axis=2) for x in (a, b))
    ratio = one[one > 0] / other[one > 0]
    return bool(np.std(ratio) / np.mean(ratio) < 0.05)
