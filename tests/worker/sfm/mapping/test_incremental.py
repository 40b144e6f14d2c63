"""Proves that the incremental mapper reports between any two of its steps, ends there when it is cancelled, and adds
photos to a model that exists.

Proven on COLMAP's own generated matches. Does not prove that the cameras of real photos are as good as those of
COLMAP's pipeline: `bench sfm` measures that.
"""

from pathlib import Path

import numpy as np
import pytest

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import Cancelled
from splatmill_worker.sfm.features import copy_without_pairs
from splatmill_worker.sfm.mapping import adjust, mapper
from tests.support.scenes.synthesized import synthesized

PHOTOS = 24


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pycolmap.Reconstruction]:
    """A database with the matches of PHOTOS photos, and their true poses."""
    path = tmp_path_factory.mktemp("incremental") / "database.db"
    return path, synthesized(path, PHOTOS)


def require_true(model: pycolmap.Reconstruction, truth: pycolmap.Reconstruction) -> None:
    aligned = pycolmap.align_reconstructions_via_proj_centers(model, truth, 0.1)
    assert aligned is not None
    for image_id in model.reg_image_ids():
        place = aligned * model.images[image_id].projection_center()
        np.testing.assert_allclose(place, truth.images[image_id].projection_center(), atol=1e-2)


def run(path: Path, reports: list[tuple[int, int, str]], stop: str | None = None) -> mapper.Mapped:
    return mapper.run(
        "incremental",
        path,
        PHOTOS,
        1,
        0,
        on_progress=lambda *report: reports.append(report),
        cancelled=lambda: stop is not None and any(stop in note for _, _, note in reports),
    )


def test_each_photo_and_each_adjustment_of_all_cameras_is_reported(
    scene: tuple[Path, pycolmap.Reconstruction],
) -> None:
    path, truth = scene
    reports: list[tuple[int, int, str]] = []
    mapped = run(path, reports)
    assert mapped.registered == PHOTOS
    require_true(mapped.models[0], truth)
    placed = [done for done, _, note in reports if note == "photos placed"]
    assert set(placed) >= set(range(3, PHOTOS + 1))
    assert placed == sorted(placed)
    adjusted = [(done, note) for done, _, note in reports if note != "photos placed"]
    # They are adjusted anew each time that their number has grown by 1.4, and at the end.
    assert len(adjusted) >= 6
    for done, note in adjusted:
        assert note.startswith(f"adjusting {done} cameras, pass ")
    assert {total for _, total, _ in reports} == {PHOTOS}


def test_a_long_adjustment_is_reported_and_ends_as_one_call_does(
    scene: tuple[Path, pycolmap.Reconstruction], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adjust, "ITERATED_OBSERVATIONS", 1)
    reports: list[tuple[int, int, str]] = []
    mapped = run(scene[0], reports)
    assert mapped.registered == PHOTOS
    require_true(mapped.models[0], scene[1])
    notes = [note for _, _, note in reports]
    first = f"adjusting {PHOTOS} cameras, pass 1"
    assert f"{first}, iteration {1 + adjust.LEAST_ITERATIONS}" in notes[notes.index(first) :]
    iterations = [int(note.split()[-1]) for note in notes if ", iteration " in note]
    assert max(iterations) <= 1 + 4 * adjust.LEAST_ITERATIONS  # of 50: the cameras are exact by then


def test_a_cancelled_mapping_ends_before_the_next_step(
    scene: tuple[Path, pycolmap.Reconstruction],
) -> None:
    reports: list[tuple[int, int, str]] = []
    with pytest.raises(Cancelled):
        run(scene[0], reports, stop="adjusting 5 cameras")
    assert reports[-1][2].startswith("adjusting 5 cameras")


def test_photos_are_added_to_a_model_by_pairs_that_were_matched_later(
    scene: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    path, truth = scene
    numbers = sorted(truth.reg_image_ids())
    late = set(numbers[-5:])
    pairs = [(a, b) for a in numbers for b in numbers if a < b and {a, b} & late]
    copy_without_pairs(path, tmp_path / "fewer.db", pairs)
    first = run(tmp_path / "fewer.db", [])
    assert set(first.models[0].reg_image_ids()) == set(numbers) - late
    reports: list[tuple[int, int, str]] = []
    extended = mapper.extend(
        first,
        path,
        PHOTOS,
        1,
        0,
        on_progress=lambda *report: reports.append(report),
        on_model=lambda _: None,
        cancelled=lambda: False,
    )
    assert set(extended.models[0].reg_image_ids()) == set(numbers)
    require_true(extended.models[0], truth)
    assert first.registered == PHOTOS - 5  # the model given is left as it was
    assert min(done for done, _, _ in reports) >= PHOTOS - 5  # it does not start over
