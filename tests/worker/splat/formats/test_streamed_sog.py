"""Proves `lod-meta.json` against its specification and against splat-transform, its bytes, and what is refused.

Does not prove the levels (tests/worker/splat/lod), nor the SOG of each chunk (test_sog.py).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.kernels.morton import morton_order
from splatmill_worker.splat.formats import ply, registry, sog, streamed_sog
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from splatmill_worker.splat.lod.levels import Levels, make_levels
from splatmill_worker.splat.lod.moments import extents
from tests.support.files.splat_transform import convert
from tests.support.gaussians import differences, matched, some_gaussians


def _scene() -> Gaussians:
    """A scene of 6000 Gaussians within a shell of 200."""
    shell = some_gaussians(200, 1, seed=1)
    shell.means[:] = 40 * torch.nn.functional.normalize(shell.means, dim=1)
    return concatenate(some_gaussians(6000, 1), shell)


@pytest.fixture(scope="module")
def levels() -> Levels:
    return make_levels(_scene(), coarsest=500, leaf=800)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, levels: Levels) -> Path:
    path = tmp_path_factory.mktemp("scene") / "lod-meta.json"
    streamed_sog.write_levels(path, levels, chunk=2000)
    return path


def _leaves(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    assert ("children" in node) != ("lods" in node)
    if "lods" in node:
        yield node
    for child in node.get("children", []):
        assert all(np.array(child["bound"]["min"]) >= np.array(node["bound"]["min"]))
        assert all(np.array(child["bound"]["max"]) <= np.array(node["bound"]["max"]))
        yield from _leaves(child)
    assert len(node.get("children", "ab")) == 2


def test_the_index_is_that_of_the_specification(written: Path, levels: Levels) -> None:
    index = json.loads(written.read_text())
    assert (index["version"], index["lodLevels"], index["lodErrors"]) == (1, 3, True)
    assert index["counts"] == [level.gaussians.count for level in levels.levels] == [6000, 1500, 375]
    assert index["count"] == 7875
    assert index["filenames"] == [f"{name}/meta.json" for name in ("0_0", "0_1", "0_2", "0_3", "1_0", "2_0")]
    leaves = list(_leaves(index["tree"]))
    assert len(leaves) == 8
    runs: dict[int, list[tuple[int, int]]] = {}
    for number, leaf in enumerate(leaves):
        assert leaf["errors"] == pytest.approx([level.errors[number] for level in levels.levels], rel=1e-6)
        for lod, place in leaf["lods"].items():
            assert index["filenames"][place["file"]].startswith(f"{lod}_")
            runs.setdefault(place["file"], []).append((place["offset"], place["count"]))
    for file, places in runs.items():
        meta = json.loads((written.parent / index["filenames"][file]).read_text())
        ends = np.cumsum([0] + [count for _, count in places])
        assert [offset for offset, _ in places] == ends[:-1].tolist()
        assert meta["count"] == ends[-1] <= 2000
    assert json.loads((written.parent / index["environment"]).read_text())["count"] == 200


def test_boxes_hold_what_is_seen_and_runs_are_in_morton_order(written: Path, levels: Levels) -> None:
    for number, leaf in enumerate(_leaves(json.loads(written.read_text())["tree"])):
        low, high = (torch.tensor(leaf["bound"][side], dtype=torch.float64) for side in ("min", "max"))
        for level in levels.levels:
            run = level.runs[number]
            part = level.gaussians.select(torch.arange(run.first, run.first + run.count))
            reach = 3 * extents(part)
            assert bool((part.means - reach >= low).all())
            assert bool((part.means + reach <= high).all())
    sides = [np.subtract(leaf["bound"]["max"], leaf["bound"]["min"]) for leaf in _leaves(_tree(written))]
    assert np.median(sides) < 0.8 * np.median(
        np.subtract(_tree(written)["bound"]["max"], _tree(written)["bound"]["min"])
    )
    run = levels.levels[0].runs[2]
    means = levels.levels[0].gaussians.means[run.first : run.first + run.count]
    order = morton_order(means, cubic=True)
    steps = [
        float((means[rows][1:] - means[rows][:-1]).norm(dim=1).median())
        for rows in (torch.arange(len(means)), order)
    ]
    assert steps[0] < 1.2 * steps[1]


def _tree(path: Path) -> dict[str, Any]:
    tree: dict[str, Any] = json.loads(path.read_text())["tree"]
    return tree


@pytest.mark.parametrize("level", [0, 1, 2])
def test_splat_transform_reads_every_level(tmp_path: Path, written: Path, levels: Levels, level: int) -> None:
    convert(written, tmp_path / "theirs.ply", "-L", str(level))
    theirs = ply.read(tmp_path / "theirs.ply").gaussians
    ours = matched(theirs, levels.levels[level].gaussians)
    errors = differences(theirs, ours)
    reach = float(ours.means.abs().max())
    assert errors["means"] <= 2 * np.log1p(reach) / 65535 / 2 * (1 + reach) * 1.01
    assert errors["opacities"] <= 1 / 255 / 2 * 1.01
    assert errors["quats"] < 3e-5
    assert float((theirs.log_scales - ours.log_scales).square().mean().sqrt()) < 0.03  # 256 values of each
    assert float((theirs.sh[:, 0] - ours.sh[:, 0]).square().mean().sqrt()) < 0.01


def test_the_environment_is_a_sog_of_what_is_far(written: Path) -> None:
    far = sog.read(written.parent / "env/meta.json").gaussians
    assert far.count == 200
    assert float(far.means.norm(dim=1).min()) > 39


def test_level_0_and_the_environment_are_read_back(tmp_path: Path) -> None:
    scene, path = _scene(), tmp_path / "new/lod-meta.json"
    assert registry.write(path, scene, offset=(1000.0, 0.0, -2.0), antialiased=True) == 6200
    back = registry.read(path)
    assert (back.offset, back.antialiased) == ((1000.0, 0.0, -2.0), True)
    assert back.gaussians.count == 6200
    errors = differences(back.gaussians, matched(back.gaussians, scene))
    assert errors["means"] < 0.01
    assert errors["opacities"] <= 1 / 255
    assert registry.size(path) == sum(
        file.stat().st_size for file in path.parent.rglob("*") if file.is_file()
    )


def test_the_same_model_gives_the_same_bytes_and_nothing_is_a_model_too(tmp_path: Path) -> None:
    scene = _scene()
    for name in ("a", "b"):
        registry.write(tmp_path / name / "lod-meta.json", scene)
    ours, theirs = (
        {
            path.relative_to(tmp_path / name): path.read_bytes()
            for path in (tmp_path / name).rglob("*")
            if path.is_file()
        }
        for name in ("a", "b")
    )
    assert ours == theirs
    assert registry.write(tmp_path / "none/lod-meta.json", scene.select(torch.arange(0))) == 0
    assert registry.read(tmp_path / "none/lod-meta.json").gaussians.count == 0


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda index: index.update(version=2), "version is 2, and only version 1"),
        (lambda index: index.pop("version"), "'version' is missing"),
        (
            lambda index: index.update(filenames=["../secret/meta.json"] * 9),
            "no meta.json in a folder beside",
        ),
        (lambda index: index.update(filenames=["/etc/meta.json"] * 9), "no meta.json in a folder beside"),
        (lambda index: index.update(filenames=["0_0/other.json"] * 9), "no meta.json in a folder beside"),
        (lambda index: index.update(filenames=["9_9/meta.json"] * 9), "9_9/meta.json, which is missing"),
        (lambda index: index.update(filenames=[]), "could not be read as Streamed SOG"),
        (lambda index: index.update(filenames=[7] * 9), "could not be read as Streamed SOG"),
        (lambda index: (index.update(tree={}), index.pop("environment")), "no leaf with level 0"),
        (lambda index: index.update(tree=3), "could not be read as Streamed SOG"),
    ],
)
def test_what_does_not_fit_is_named(
    tmp_path: Path, written: Path, change: Callable[[dict[str, Any]], Any], says: str
) -> None:
    index = json.loads(written.read_text())
    change(index)
    (tmp_path / "lod-meta.json").write_text(json.dumps(index))
    with pytest.raises(ModelUnreadable, match=says):
        registry.read(tmp_path / "lod-meta.json")


def test_damaged_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "lod-meta.json"
    for text in ("", "[" * 10**5, "null", "[]", "{}", " " * (streamed_sog.MAX_INDEX_BYTES + 1)):
        path.write_text(text)
        with pytest.raises(ModelUnreadable, match=r"lod-meta\.json"):
            registry.read(path)
    with pytest.raises(FileNotFoundError):
        registry.read(tmp_path / "none/lod-meta.json")
