"""Proves that a higher effort keeps the features and pairs of photos that are not searched anew, the cache's keys, and
which mappers are tried.

Proven on the database of generated photos. Does not prove that a higher effort registers more photos.
"""

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatmill_worker import sfm, synthetic
from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm import effort, features, options, solve, trials
from splatmill_worker.sfm.mapping import mapper
from splatmill_worker.sfm.matching import pairs
from splatmill_worker.sfm.run import SfmRun
from tests.support.scenes.motions import FOCAL, ball, model_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("effort")
    synthetic.capture(folder / "images", 8, 240, 180, samples=1)
    options = sfm.SfmOptions(effort="lean", stereo=False)
    with suppress(sfm.SfmFailed):  # few may be registered; features and pairs are stored
        sfm.reconstruct(folder / "images", None, folder / "work", options, lambda *_: None, lambda: False)
    return next((folder / "work").rglob("database.db"))


def test_only_photos_searched_anew_lose_their_features_and_pairs(source: Path, tmp_path: Path) -> None:
    target = tmp_path / "next.db"
    features.carry_over(source, target, {2, 5})
    old, new = pycolmap.Database.open(source), pycolmap.Database.open(target)
    try:
        ids = {features.photo_index(image.name): image.image_id for image in new.read_all_images()}
        assert ids == {features.photo_index(image.name): image.image_id for image in old.read_all_images()}
        for photo, image_id in ids.items():
            assert new.exists_keypoints(image_id) == (photo not in (2, 5))
            assert new.exists_descriptors(image_id) == (photo not in (2, 5))
            if photo not in (2, 5):
                np.testing.assert_array_equal(new.read_keypoints(image_id), old.read_keypoints(image_id))
        matched = 0
        for first, second in pairs.exhaustive(len(ids)):
            a, b = ids[first], ids[second]
            kept = old.exists_matches(a, b) and not {first, second} & {2, 5}
            assert new.exists_matches(a, b) == kept
            assert new.exists_two_view_geometry(a, b) == kept
            matched += kept
        assert matched > 5
    finally:
        old.close()
        new.close()


def test_a_database_that_exists_is_left_as_it_is(source: Path, tmp_path: Path) -> None:
    target = tmp_path / "next.db"
    features.carry_over(source, target, {0})
    stamp = target.stat().st_mtime_ns
    features.carry_over(source, target, {1, 2, 3})
    assert target.stat().st_mtime_ns == stamp


def test_another_seed_or_matcher_has_a_database_of_its_own(tmp_path: Path) -> None:
    synthetic.capture(tmp_path / "images", 4, 120, 90, samples=1)
    changes: tuple[dict[str, Any], ...] = ({}, {"seed": 1}, {"matcher": "sequential"}, {})
    for changed in changes:
        options = sfm.SfmOptions(effort="lean", stereo=False, **changed)
        with suppress(sfm.SfmFailed):
            sfm.reconstruct(
                tmp_path / "images", None, tmp_path / "work", options, lambda *_: None, lambda: False
            )
    assert len(list((tmp_path / "work").rglob("database.db"))) == 3


@pytest.mark.parametrize(
    ("registered", "tried"),
    [
        (7, [("incremental", False)]),
        (6, [("incremental", False), ("global", False), ("incremental", True)]),
        (0, [("incremental", False), ("global", False), ("incremental", True)]),
    ],
)
def test_no_other_mapper_is_tried_for_photos_that_nothing_connects(
    registered: int, tried: list[tuple[str, bool]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of ten photos seven are connected, so that no mapper registers more."""
    chain = [(first, first + 1) for first in range(6)]
    assert _tried(10, chain, registered, tmp_path, monkeypatch) == tried


@pytest.mark.parametrize(
    ("registered", "again", "called", "kept"),
    [(5, 6, "extended", 6), (5, 4, "extended", 5), (4, 9, "anew", 9), (4, 3, "anew", 4)],
    ids=["more", "fewer", "less than half, more", "less than half, fewer"],
)
def test_more_pairs_add_photos_to_a_model_that_has_half_of_them(
    registered: int, again: int, called: str, kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def answer(name: str) -> Any:
        def mapping(*_: object) -> SimpleNamespace:
            calls.append(name)
            return SimpleNamespace(registered=again)

        return mapping

    monkeypatch.setattr(effort, "extended_mapping", answer("extended"))
    monkeypatch.setattr(effort, "best_mapping", answer("anew"))
    monkeypatch.setattr(effort, "registered_counts", lambda mapped: (mapped.registered, mapped.registered))
    run: Any = SimpleNamespace(count=10)
    result: Any = SimpleNamespace(database=None, verified=[])
    mapped: Any = SimpleNamespace(registered=registered)
    assert effort._mapped_with_more(run, result, mapped).registered == kept
    assert calls == [called]


@pytest.mark.parametrize(
    ("registered", "alone", "tried", "best"),
    [(7, [], 1, 0), (7, [8, 9], 1, 0), (7, [6], 2, 1), (6, [], 4, 0)],
    ids=["all", "what nothing connects is left", "a connected photo is left", "too few"],
)
def test_clusters_that_do_not_join_are_mapped_in_one_piece(
    registered: int,
    alone: list[int],
    tried: int,
    best: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of ten photos seven are connected; the model with more of them is the outcome."""
    chain = [(first, first + 1) for first in range(6)]
    calls: list[tuple[str, int]] = []

    def model(photos: list[int]) -> Any:
        images = {photo: SimpleNamespace(name=f"camera0/{photo:06d}") for photo in photos}
        return SimpleNamespace(
            images=images, reg_image_ids=lambda: photos, num_reg_images=lambda: len(photos)
        )

    outcomes: list[mapper.Mapped] = []

    def run(name: mapper.Mapper, *_: object, cluster_models: tuple[Any, ...], **__: object) -> mapper.Mapped:
        calls.append((name, len(cluster_models)))
        own = alone if cluster_models else []
        models = [model([photo for photo in range(registered) if photo not in own]), model(own)]
        outcomes.append(mapper.Mapped(name, tuple(models[: 1 + bool(own)]), 0))
        return outcomes[-1]

    monkeypatch.setattr(mapper, "run", run)
    monkeypatch.setattr(trials, "registered_counts", lambda mapped: (mapped.registered, mapped.registered))
    asked: Any = SimpleNamespace(
        options=sfm.SfmOptions(), best_mapper=None, count=10, threads=1, show=None, cancelled=None, on_mapping=None,
        clock=lambda _: nullcontext(),
    )  # fmt: skip
    clusters = [model([0, 1, 2, 3]), model([3, 4, 5, 6])]
    assert trials.best_mapping(asked, tmp_path / "database.db", chain, clusters) is outcomes[best]
    assert calls == [("incremental", 2), ("incremental", 0), ("global", 0), ("incremental", 0)][:tried]


def _tried(
    count: int,
    verified: list[tuple[int, int]],
    registered: int,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> list[tuple[str, bool]]:
    """The mappers that are tried, and whether relaxed, where each registers as many photos."""
    calls: list[tuple[str, bool]] = []

    def run(name: mapper.Mapper, *_: object, relaxed: bool, **__: object) -> mapper.Mapped:
        calls.append((name, relaxed))
        return mapper.Mapped(name, (), 0)

    monkeypatch.setattr(mapper, "run", run)
    monkeypatch.setattr(trials, "registered_counts", lambda _: (registered, registered))
    asked: Any = SimpleNamespace(
        options=sfm.SfmOptions(), best_mapper=None, count=count, threads=1, show=None, cancelled=None, on_mapping=None,
        clock=lambda _: nullcontext(),
    )  # fmt: skip
    trials.best_mapping(asked, folder / "database.db", verified)
    return calls


@pytest.mark.parametrize(
    ("count", "registered", "spent", "tried"),
    [
        (50, 30, 9.0, ["lean", "standard", "high"]),
        (50, 30, 11.0, ["lean"]),
        (
            50,
            20,
            11.0,
            ["lean", "standard", "high"],
        ),  # a model of less than half of the photos is no result yet
        (50, 50, 11.0, ["lean"]),
        (solve.FEW_PHOTOS, 20, 9.0, ["standard", "high"]),
        (solve.FEW_PHOTOS, 20, 11.0, ["standard"]),
    ],
)
def test_no_higher_effort_is_tried_where_there_is_no_time_for_it(
    count: int,
    registered: int,
    spent: float,
    tried: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[str] = []
    full = [SimpleNamespace(scales=np.ones(options.HIGH.features))]

    def solve_at(_run: object, tried_effort: options.Effort, _best: object) -> Any:
        calls.append(tried_effort.name)
        return SimpleNamespace(mapped=None, effort=tried_effort, verified=[(0, 1)], features=full)

    monkeypatch.setattr(solve, "solve_at", solve_at)
    monkeypatch.setattr(solve, "registered_counts", lambda _: (registered, registered))
    monkeypatch.setattr(solve, "unfold", lambda *_: None)
    prepared: Any = SimpleNamespace(
        photos=[SimpleNamespace(width=640, height=480, is_panorama=False)] * count
    )
    asked = sfm.SfmOptions(seconds=40.0)
    with ThreadPoolExecutor(1) as pool:
        run = SfmRun(prepared, [], "SIMPLE_RADIAL", asked, tmp_path, 1, pool, lambda *_: None, lambda: False)
        run.began -= spent
        solve._solve(run)
    assert calls == tried
    assert (
        run.hurried
        == any("There was no time to try" in note for note in run.notes)
        == (len(tried) == 1 and registered < count)
    )


@pytest.mark.parametrize(("feature_count", "tried"), [(31, ["lean", "high"]), (29, ["lean"])])
def test_the_next_effort_but_one_is_tried_where_the_next_would_find_the_same(
    feature_count: int, tried: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def solve_at(_run: object, tried_effort: options.Effort, _best: object) -> Any:
        calls.append(tried_effort.name)
        few = [SimpleNamespace(scales=np.ones(feature_count))] * 50
        return SimpleNamespace(mapped=None, effort=tried_effort, verified=[(0, 1)], features=few)

    monkeypatch.setattr(solve, "solve_at", solve_at)
    monkeypatch.setattr(solve, "registered_counts", lambda _: (3, 3))
    monkeypatch.setattr(solve, "unfold", lambda *_: None)
    prepared: Any = SimpleNamespace(photos=[SimpleNamespace(width=640, height=480, is_panorama=False)] * 50)
    with ThreadPoolExecutor(1) as pool:
        run = SfmRun(
            prepared, [], "SIMPLE_RADIAL", sfm.SfmOptions(), tmp_path, 1, pool, lambda *_: None, lambda: False
        )
        with nullcontext() if len(tried) > 1 else pytest.raises(sfm.SfmFailed, match="at most 29 features"):
            solve._solve(run)
    assert calls == tried


@pytest.mark.parametrize(
    ("feature_count", "count", "side", "matcher", "skipped"),
    [
        (options.LEAN.features - 1, 10, 640, "auto", {"standard", "high"}),
        (options.LEAN.features - 1, pairs.EXHAUSTIVE_UP_TO + 1, 640, "auto", {"standard"}),  # more pairs
        (options.LEAN.features - 1, pairs.EXHAUSTIVE_UP_TO + 1, 640, "exhaustive", {"standard", "high"}),
        (options.LEAN.features - 1, 10, 640, "sequential", {"standard"}),
        (options.LEAN.features - 1, 10, 641, "auto", set()),
        (options.LEAN.features, 10, 640, "auto", set()),
    ],
)
def test_an_effort_that_would_find_the_same_is_left_out(
    feature_count: int, count: int, side: int, matcher: Any, skipped: set[str]
) -> None:
    run: Any = SimpleNamespace(
        count=count,
        reduced_side=lambda effort: min(effort.side, side),
        options=sfm.SfmOptions(matcher=matcher),
    )
    best: Any = SimpleNamespace(
        effort=options.LEAN, features=[SimpleNamespace(scales=np.ones(each)) for each in (3, feature_count)]
    )
    higher = options.STANDARD, options.HIGH
    assert {each.name for each in higher if solve._finds_the_same(run, best, each)} == skipped


def test_a_higher_effort_begins_with_the_model_of_the_photos_that_it_does_not_retry() -> None:
    model = model_of(ball, FOCAL)
    for image_id, image in model.images.items():
        image.name = features.reduced_name(0, image_id)
    retried = {image_id for image_id in model.reg_image_ids() if image_id % 3 == 0}
    mapped = mapper.Mapped("incremental", (model, pycolmap.Reconstruction()), 0)
    kept = effort._without(mapped, retried)
    assert kept is not None
    assert kept.largest is not None
    assert set(kept.largest.images) == set(model.images) - retried
    assert kept.registered == 24
    assert 0 < kept.largest.num_points3D() <= model.num_points3D()
    for image_id in kept.largest.reg_image_ids():
        same = model.images[image_id].cam_from_world().matrix()
        np.testing.assert_allclose(kept.largest.images[image_id].cam_from_world().matrix(), same)
    assert model.num_reg_images() == 36
    assert effort._without(None, retried) is None


@pytest.mark.parametrize(
    ("largest", "sides"),
    [(640, {640}), (1000, {640, 800, 1000}), (4000, {640, 800, 1400})],
    ids=["small", "middle", "large"],
)
def test_photos_that_no_effort_reduces_are_of_one_size_for_all(
    largest: int, sides: set[int], tmp_path: Path
) -> None:
    photos = [SimpleNamespace(width=320, height=240), SimpleNamespace(width=largest // 2, height=largest)]
    prepared: Any = SimpleNamespace(photos=photos)
    with ThreadPoolExecutor(1) as pool:
        run = SfmRun(
            prepared, [], "SIMPLE_RADIAL", sfm.SfmOptions(), tmp_path, 1, pool, lambda *_: None, lambda: False
        )
        assert {run.reduced_side(each) for each in options.EFFORTS.values()} == sides
