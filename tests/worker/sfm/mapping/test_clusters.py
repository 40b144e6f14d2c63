"""Proves that clusters of a view graph are of one size, that photos which match each other stay together, and that
clusters that were mapped apart are joined into one model of all photos.

Proven on graphs of which the best cut is known, and on COLMAP's own generated matches. Does not prove how good the
cameras of many photos are: `bench ground` measures that.
"""

from __future__ import annotations

import random
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
import pytest

from splatmill_worker.colmap import pycolmap, write_model
from splatmill_worker.errors import Cancelled
from splatmill_worker.sfm.mapping import cluster_models, clusters, mapper
from tests.support.scenes.synthesized import synthesized

PHOTOS = 24


def never() -> bool:
    return False


@pytest.mark.parametrize(("count", "number"), [(0, 0), (499, 0), (500, 2), (749, 2), (1000, 4), (10_000, 40)])
def test_only_captures_of_twice_the_size_of_a_cluster_have_clusters(count: int, number: int) -> None:
    assert clusters.number_of_clusters(count) == number


def grid(rows: int, columns: int) -> dict[tuple[int, int], int]:
    """Photos in strips: each matches the next one, and less well the one in the next strip."""
    edges = {}
    for row in range(rows):
        for column in range(columns):
            photo = row * columns + column
            if column + 1 < columns:
                edges[photo, photo + 1] = 90
            if row + 1 < rows:
                edges[photo, photo + columns] = 40
    return edges


def cut(parts: list[list[int]], edges: dict[tuple[int, int], int]) -> int:
    """The inliers between photos that no cluster has both of."""
    return sum(weight for pair, weight in edges.items() if not any(set(pair) <= set(part) for part in parts))


@pytest.mark.parametrize("seed", range(5))
def test_groups_that_hardly_match_each_other_are_told_apart(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four groups of 30 photos, whose names are in no order, with a chain of single matches from one to the next."""
    monkeypatch.setattr(clusters, "CLUSTER_PHOTOS", 30)
    choose = random.Random(seed)
    photos = list(range(120))
    choose.shuffle(photos)
    groups = [photos[start : start + 30] for start in range(0, 120, 30)]
    edges = {}
    for group in groups:
        for _ in range(300):
            first, second = sorted(choose.sample(group, 2))
            edges[first, second] = choose.randint(40, 200)
    for one, other in pairwise(groups):
        edges[min(one[0], other[1]), max(one[0], other[1])] = 20
    divided = clusters.divide(120, edges, never)
    assert len(divided) == 4
    for group in groups:
        assert [part for part in divided if set(group) <= set(part)], "no group is divided"
        assert len(max(divided, key=lambda part: len(set(group) & set(part)))) <= 32, "and has its neighbours"


def test_strips_are_cut_across_their_shorter_side(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters, "CLUSTER_PHOTOS", 100)
    monkeypatch.setattr(clusters, "SHARED", 0.0)
    edges = grid(10, 20)
    divided = clusters.divide(200, edges, never)
    assert [len(part) for part in divided] == [100, 100]
    assert sorted(chain(*divided)) == list(range(200))
    assert cut(divided, edges) <= 20 * 40  # along the strips; across all of them it is 900


def test_a_cluster_has_the_nearest_photos_of_its_neighbours_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters, "CLUSTER_PHOTOS", 40)
    edges = {(photo, photo + step): 100 // step for step in (1, 2, 3) for photo in range(80 - step)}
    first, second = sorted(clusters.divide(80, edges, never))
    assert first == list(range(43)), "three that match it, of five that it may have"
    assert second == list(range(37, 80))


def test_photos_without_matches_are_in_some_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters, "CLUSTER_PHOTOS", 10)
    divided = clusters.divide(40, {(0, 1): 30}, never)
    assert sorted(chain(*divided)) == list(range(40))
    assert clusters.divide(40, {(0, 1): 30}, never) == divided


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pycolmap.Reconstruction]:
    """A database with the matches of PHOTOS photos, and their true poses."""
    path = tmp_path_factory.mktemp("clusters") / "database.db"
    return path, synthesized(path, PHOTOS)


def mapped_apart(
    path: Path, parts: list[list[int]], placed: list[int] | None = None
) -> list[pycolmap.Reconstruction]:
    models = []
    for images in parts:
        models += cluster_models.mapped_cluster(
            path,
            images,
            1,
            0,
            on_progress=lambda done: None if placed is None else placed.append(done),
            on_model=lambda model: None,
            cancelled=never,
        )
    return models


def joined(path: Path, models: list[pycolmap.Reconstruction]) -> mapper.Mapped:
    return mapper.run(
        "incremental", path, PHOTOS, 1, 0, cluster_models=models, on_progress=lambda *_: None, cancelled=never
    )


def test_clusters_are_mapped_once_and_joined(scene: tuple[Path, pycolmap.Reconstruction]) -> None:
    path, truth = scene
    ids = sorted(truth.reg_image_ids())
    parts = [ids[:10], ids[6:17], ids[13:]]
    placed: list[int] = []
    models = mapped_apart(path, parts, placed)
    assert [model.num_reg_images() for model in models] == [10, 11, 11]
    assert {10, 11} <= set(placed)
    assert all(set(model.reg_image_ids()) <= set(part) for model, part in zip(models, parts, strict=True))
    again: list[int] = []
    mapped_apart(path, parts, again)
    assert again == [10, 11, 11], "the stored ones are read"
    mapped = joined(path, models)
    assert (mapped.registered, mapped.merged, len(mapped.models)) == (PHOTOS, 2, 1)
    model = mapped.models[0]
    aligned = pycolmap.align_reconstructions_via_proj_centers(model, truth, 0.1)
    assert aligned is not None
    for image_id in model.reg_image_ids():
        place = aligned * model.images[image_id].projection_center()
        np.testing.assert_allclose(place, truth.images[image_id].projection_center(), atol=1e-2)
    one = mapper.run("incremental", path, PHOTOS, 1, 0, on_progress=lambda *_: None, cancelled=never)
    assert one.models[0].num_points3D() == model.num_points3D()
    assert one.models[0].compute_num_observations() == model.compute_num_observations(), (
        "tracks cross the seams"
    )


def test_photos_that_no_cluster_has_are_added(
    scene: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    path, truth = scene
    ids = sorted(truth.reg_image_ids())
    there = tmp_path / "database.db"
    there.write_bytes(path.read_bytes())
    models = mapped_apart(there, [ids[:9], ids[5:14]])
    assert joined(there, models).registered == PHOTOS


def test_another_choice_of_photos_is_mapped_anew_and_a_damaged_model_too(
    scene: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    there = tmp_path / "database.db"
    there.write_bytes(scene[0].read_bytes())
    ids = sorted(scene[1].reg_image_ids())
    (first,) = mapped_apart(there, [ids[:9]])
    placed: list[int] = []
    (second,) = mapped_apart(there, [ids[:12]], placed)
    assert (first.num_reg_images(), second.num_reg_images()) == (9, 12)
    assert len(placed) > 1, "not read"
    folder = cluster_models.folder_of(there, ids[:9])
    points = folder / "0" / "points3D.bin"
    points.write_bytes(points.read_bytes()[:100])
    folder.with_name(f"{folder.name}.partial").mkdir()  # of a process that was killed
    placed.clear()
    (again,) = mapped_apart(there, [ids[:9]], placed)
    assert len(placed) > 1
    assert again.num_points3D() == first.num_points3D()
    assert [path.name for path in folder.parent.iterdir() if path.name.startswith(folder.name)] == [
        folder.name
    ]


@pytest.mark.parametrize("steps", [3, 10**9], ids=["in a step", "at the end"])
def test_a_cancelled_cluster_leaves_no_models(
    scene: tuple[Path, pycolmap.Reconstruction],
    tmp_path: Path,
    steps: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    there = tmp_path / "database.db"
    there.write_bytes(scene[0].read_bytes())
    ids = sorted(scene[1].reg_image_ids())[:9]
    calls: list[int] = []
    written: list[Path] = []

    def write(model: pycolmap.Reconstruction, folder: Path) -> None:
        write_model(model, folder)
        written.append(folder)

    monkeypatch.setattr(cluster_models, "write_model", write)
    with pytest.raises(Cancelled):
        cluster_models.mapped_cluster(
            there,
            ids,
            1,
            0,
            on_progress=calls.append,
            on_model=lambda model: None,
            cancelled=lambda: len(calls) > steps or bool(written),
        )
    assert bool(written) == (steps > 3)
    assert not cluster_models.folder_of(there, ids).exists()
    assert mapped_apart(there, [ids])[0].num_reg_images() == 9


def test_a_division_can_be_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters, "CLUSTER_PHOTOS", 10)
    with pytest.raises(Cancelled):
        clusters.divide(40, {(0, 1): 30}, lambda: True)
