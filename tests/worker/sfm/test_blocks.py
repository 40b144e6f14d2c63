"""Proves that features, matches and models of clusters found in blocks are those that one process finds, also where a
block was lost, and that the mapping begins from them.

Proven on generated photos of two sizes, some of them masked. Does not prove that other machines find the blocks
(tests/worker/service/units, tests/service/test_tiles.py).
"""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker import sfm, synthetic
from splatmill_worker.errors import Cancelled
from splatmill_worker.images.prepare import Prepared, prepare
from splatmill_worker.sfm import blocks
from splatmill_worker.sfm.blocks import Block
from splatmill_worker.sfm.features import photos_in
from splatmill_worker.sfm.mapping import clusters

pytestmark = pytest.mark.slow

COUNT = 16
OPTIONS = sfm.SfmOptions(stereo=False, threads=1)  # of several, the order of the sums is by chance

PARTS = "part 1 of 2, photos placed", "part 2 of 2, photos placed"
"""Notes of the progress while two clusters are mapped."""


def silent(stage: str, done: int, total: int, note: str) -> None:
    """Report nothing."""


def never() -> bool:
    return False


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    """Photos of two sizes, more than are matched exhaustively, of which one has a mask."""
    root = tmp_path_factory.mktemp("blocks")
    synthetic.capture(root / "images", COUNT - 4, 320, 240, samples=1)
    synthetic.capture(root / "small", 4, 200, 150, samples=1)
    for path in (root / "small").iterdir():
        shutil.move(path, root / "images" / f"s-{path.name}")
    masked = sorted((root / "images").iterdir())[3]
    (root / "masks").mkdir()
    mask = np.full((240, 320), 255, np.uint8)
    mask[:, :80] = 0
    Image.fromarray(mask).save(root / "masks" / f"{masked.stem}.png")
    result = prepare(root / "images", root / "masks", root)
    assert (len(result.photos), sum(photo.mask is not None for photo in result.photos)) == (COUNT, 1)
    return result


@pytest.fixture(scope="module")
def whole(prepared: Prepared, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The work folder of one process that was stopped when it began to place photos."""
    work, stages = tmp_path_factory.mktemp("whole"), [""]
    with pytest.raises(Cancelled):
        sfm.reconstruct_photos(
            prepared, work, OPTIONS, lambda stage, *_: stages.append(stage), lambda: stages[-1] == "mapping"
        )
    return work


def rows(path: Path, table: str) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(path)) as database:
        return sorted(database.execute(f"SELECT * FROM {table}"))


def database_in(work: Path) -> Path:
    """That of the first effort, where there is no other."""
    (path,) = work.rglob("database.db")
    return path


def files_below(folder: Path, root: Path | None = None) -> set[Path]:
    return {path.relative_to(root or folder) for path in folder.rglob("*") if path.is_file()}


def in_blocks(prepared: Prepared, root: Path, count: int, lost: int | None = None) -> tuple[list[Path], Path]:
    """The work folders of all parts, and that in which they are merged. lost: number of a block without features."""
    features = []
    for number in range(1, count + 1):
        if number != lost:
            features.append(root / f"features-{number}")
            size = blocks.find_block(prepared, features[-1], OPTIONS, Block(number, count), silent, never)
            assert size in (COUNT // count, COUNT // count + 1)
    scored = root / "pairs"
    chosen = blocks.score_pairs(prepared, scored, OPTIONS, features, silent, never)
    assert len(photos_in(database_in(scored), with_features=True)) == (0 if lost is None else COUNT // count)
    parts = [*features, scored]
    matched = 0
    for number in range(1, count + 1):
        part = root / f"matches-{number}"
        block = Block(number, count)
        matched += blocks.match_block(prepared, part, OPTIONS, block, [*features, scored], silent, never)
        assert rows(database_in(part), "descriptors") == []
        parts.append(part)
    assert matched == chosen > COUNT
    before = files_below(root)
    blocks.merge(parts, root / "all", lambda done, total: None, never)
    assert files_below(root) - before == {
        path for path in files_below(root / "all", root) if path.name in ("database.db", "scores.npz")
    }, "nothing is written beside what is read"
    return parts, root / "all"


@pytest.mark.parametrize(("count", "lost"), [(1, None), (3, None), (3, 2)])
def test_the_database_is_that_of_one_process(
    prepared: Prepared, whole: Path, tmp_path: Path, count: int, lost: int | None
) -> None:
    _, work = in_blocks(prepared, tmp_path, count, lost)
    merged = database_in(work)
    whole /= merged.relative_to(work)
    for table in ("cameras", "images", "frames", "frame_data", "rigs"):
        assert rows(merged, table) == rows(whole, table), table
    for table in ("two_view_geometries", "matches"):  # of one process, also the pairs that connect components
        assert set(rows(merged, table)) <= set(rows(whole, table)), table
    assert len(rows(whole, "cameras")) == 2
    for table in ("keypoints", "descriptors"):
        assert rows(merged, table) == rows(whole, table), table


def test_what_is_there_is_not_found_again(prepared: Prepared, tmp_path: Path) -> None:
    parts, work = in_blocks(prepared, tmp_path, 2)
    before = {table: rows(database_in(work), table) for table in ("descriptors", "matches")}
    reports = []
    blocks.merge(parts, work, lambda done, total: reports.append((done, total)), never)  # once more
    assert reports == [(number, 5) for number in range(1, 6)]
    with pytest.raises(Cancelled):
        blocks.merge(parts, work, lambda done, total: None, lambda: True)
    assert {table: rows(database_in(work), table) for table in before} == before
    stages = []
    with suppress(sfm.SfmFailed):
        sfm.reconstruct_photos(
            prepared, work, OPTIONS, lambda stage, done, total, note: stages.append((stage, total))
        )
    first = next(index for index, (stage, _) in enumerate(stages) if stage == "mapping")
    assert {stage for stage, _ in stages[:first]} <= {"matching"}, "only pairs that connect components"


@pytest.mark.parametrize("lost", [None, "features", "matches"])
def test_clusters_mapped_in_blocks_are_those_of_one_process(
    prepared: Prepared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lost: str | None
) -> None:
    monkeypatch.setattr(clusters, "CLUSTER_PHOTOS", 8)
    stages = [("", "")]
    with pytest.raises(Cancelled):
        sfm.reconstruct_photos(
            prepared,
            tmp_path / "whole",
            OPTIONS,
            lambda stage, done, total, note: stages.append((stage, note)),
            lambda: (
                stages[-1][0] == "mapping" and stages[-1][1] not in (*PARTS, "dividing the photos into parts")
            ),
        )
    assert {note for stage, note in stages if stage == "mapping"} >= {*PARTS}
    before, work = in_blocks(prepared, tmp_path, 3, 2 if lost == "features" else None)
    if lost == "matches":
        before = [part for part in before if part.name != "matches-2"]
    parts = list(before)
    for number in (1, 2, 3):
        part = tmp_path / f"mapping-{number}"
        placed = blocks.map_block(prepared, part, OPTIONS, Block(number, 3), before, silent, never)
        if lost == "matches":
            assert placed == 0, "one process finds them, and maps the clusters"
            assert not [path for path in part.rglob("*") if path.is_file()]
            continue
        assert (placed > 0) == (number < 3), "two clusters"
        left = {path.relative_to(part).parts[3] for path in part.rglob("*") if path.is_file()}
        assert left == ({"clusters"} if number < 3 else set()), "nothing else is kept"
        parts.append(part)
    if lost == "matches":
        return
    blocks.merge(parts, work, lambda done, total: None, never)
    ours, theirs = (database_in(folder).with_name("clusters") for folder in (work, tmp_path / "whole"))
    assert files_below(ours) == files_below(theirs) != set()
    for name in files_below(ours):
        assert (ours / name).read_bytes() == (theirs / name).read_bytes(), name
    stages.clear()
    with suppress(sfm.SfmFailed, Cancelled):
        sfm.reconstruct_photos(
            prepared,
            work,
            OPTIONS,
            lambda stage, done, total, note: stages.append((stage, note)),
            lambda: bool(stages) and stages[-1] == ("mapping", "photos placed"),
        )
    assert [note for _, note in stages if ", photos placed" in note] == [*PARTS], "each is read, not mapped"


def test_progress_is_that_of_the_block_and_a_cancelled_one_ends(prepared: Prepared, tmp_path: Path) -> None:
    reports = []
    blocks.find_block(
        prepared,
        tmp_path,
        OPTIONS,
        Block(2, 4),
        lambda stage, done, total, note: reports.append((stage, done, total, note)),
        never,
    )
    names = [photo.name for photo in prepared.photos[4:8]]
    assert reports == [("features", number, 4, name) for number, name in enumerate(names, 1)]
    with pytest.raises(Cancelled):
        blocks.find_block(prepared, tmp_path / "other", OPTIONS, Block(1, 1), silent, lambda: True)


@pytest.mark.parametrize("blocks_of", [1, 3, 7, 64])
def test_every_index_is_in_one_block(blocks_of: int) -> None:
    whole = [index for number in range(1, blocks_of + 1) for index in Block(number, blocks_of).of(20)]
    assert whole == list(range(20))
