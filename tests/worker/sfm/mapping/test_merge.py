"""Proves that models that share photos are merged into one, in the world of the first, and others are left apart.

Proven on parts of a model of generated photos. Does not prove that the models of a mapper, each with errors of its own,
always agree well enough to be merged.
"""

import copy
from pathlib import Path

import numpy as np
import pytest

from splatmill_worker import sfm, synthetic
from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.mapping import mapper
from splatmill_worker.sfm.mapping.merge import merge

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> pycolmap.Reconstruction:
    folder = tmp_path_factory.mktemp("merge")
    synthetic.capture(folder / "images", 18, 320, 240, samples=1)
    options = sfm.SfmOptions(effort="lean", stereo=False)
    sfm.reconstruct(folder / "images", None, folder / "work", options, lambda *_: None, lambda: False)
    stored = next((folder / "work").rglob("facts.json"))
    return pycolmap.Reconstruction(stored.parent)


def part(model: pycolmap.Reconstruction, first: int, last: int, folder: Path) -> pycolmap.Reconstruction:
    """Photos `first` to `last` (by name) alone, as a mapper hands them over: without the others."""
    result = copy.deepcopy(model)
    ordered = sorted(result.reg_image_ids(), key=lambda image_id: result.images[image_id].name)
    for image_id in ordered[:first] + ordered[last:]:
        result.deregister_frame(result.images[image_id].frame_id)
    folder.mkdir()
    result.write_binary(folder)
    return pycolmap.Reconstruction(folder)


def moved(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    turn = pycolmap.Rotation3d(np.array([0.1, -0.4, 0.2, 0.8]) / np.linalg.norm([0.1, -0.4, 0.2, 0.8]))
    model.transform(pycolmap.Sim3d(2.5, turn, np.array([3.0, -1.0, 7.0])))
    return model


def test_two_halves_that_share_photos_are_merged(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    count = model.num_reg_images()
    assert count >= 12
    left, right = part(model, 0, 9, tmp_path / "left"), moved(part(model, 5, count, tmp_path / "right"))
    assert (left.num_images(), right.num_images()) == (9, count - 5)
    whole, merged = merge([left, right])
    assert merged == [1]
    assert left.num_reg_images() == 9  # the model given is left as it was
    assert whole.num_reg_images() == count
    for image_id in model.reg_image_ids():
        there = whole.images[image_id].projection_center()
        np.testing.assert_allclose(there, model.images[image_id].projection_center(), atol=1e-3)
    assert whole.num_points3D() >= 0.9 * model.num_points3D()
    assert whole.compute_mean_reprojection_error() < 1.5
    for point in whole.points3D.values():
        assert len({element.image_id for element in point.track.elements}) >= 2


def test_models_that_colmap_fails_to_merge_are_left_apart(
    model: pycolmap.Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = model.num_reg_images()
    left, right = part(model, 0, 9, tmp_path / "left"), part(model, 5, count, tmp_path / "right")

    def refuse(models: list[pycolmap.Reconstruction]) -> None:
        # Raises COLMAP's own error; no two models are known for which merging fails.
        model.images[model.reg_image_ids()[0]].points2D = pycolmap.Point2DList()

    monkeypatch.setattr(mapper, "merge", refuse)
    models, merged, notes = mapper.merge_models([left, right])
    assert [id(each) for each in models] == [id(left), id(right)]
    assert merged == 0
    assert "merging them failed" in notes[0]
    assert "Check failed" in notes[0]


def test_models_that_share_too_few_photos_are_left_apart(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    count = model.num_reg_images()
    left, right = part(model, 0, 8, tmp_path / "left"), moved(part(model, 6, count, tmp_path / "right"))
    whole, merged = merge([left, right])
    assert merged == []
    assert whole is left
