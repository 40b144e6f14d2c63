"""Proves that views of a model in levels of detail read what they draw, within bounds of error and memory.

Does not prove the choice of levels (tests/worker/splat/lod/test_choice.py), nor how the levels are made.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.readers import reader_memory
from splatmill_worker.scene import Camera
from splatmill_worker.splat.formats import registry, streamed_sog, streamed_views, streamed_zip
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.lod.choice import TOLERANCE
from splatmill_worker.splat.lod.levels import make_levels
from splatmill_worker.splat.render import render

COUNT = 60_000


def wall() -> Gaussians:
    """Gaussians on a coloured wall of 40 x 40, each about as wide as twice its distance to the next."""
    made = torch.Generator().manual_seed(0)
    means = torch.rand(COUNT, 3, generator=made) * torch.tensor([40, 40, 0.2]) - torch.tensor([20, 20, 0.1])
    waves = torch.stack([means[:, 0], means[:, 1], means[:, 0] + means[:, 1]], 1)
    return Gaussians(
        means,
        torch.tensor([-1.2, -1.2, -4.0]).expand(COUNT, 3).clone(),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(COUNT, 4).clone(),
        torch.full((COUNT,), -1.0),
        (0.5 * torch.sin(waves))[:, None],
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "lod-meta.json"
    levels = make_levels(wall(), coarsest=1000, leaf=1000)
    streamed_sog.write_levels(path, levels, offset=(5.0, 0.0, 0.0), antialiased=True, chunk=2000)
    return path


def towards(x: float, distance: float) -> Camera:
    """A camera before the wall that looks straight at it."""
    viewmat = np.eye(4)
    viewmat[:3, 3] = [-x, 0.0, distance]
    return Camera(160, 120, 150.0, 150.0, 80.0, 60.0, viewmat)


def psnr(found: torch.Tensor, wanted: torch.Tensor) -> float:
    return float(-10 * torch.log10((found - wanted).square().mean()))


@pytest.mark.parametrize(("x", "distance"), [(0, 3), (12, 3), (0, 12), (-15, 12)])
def test_a_near_view_is_that_of_all_gaussians_and_takes_those_in_view(
    written: Path, x: float, distance: float
) -> None:
    whole, camera = registry.read(written).gaussians, towards(x, distance)
    with streamed_views.opened(written) as model:
        assert model is not None
        drawn = model.seen_by(camera)
        assert model.count == whole.count == COUNT
    assert drawn.count < COUNT / 2
    wanted = render(whole, camera, antialias=True)
    torch.testing.assert_close(render(drawn, camera, antialias=True).color, wanted.color, rtol=0, atol=1e-5)


@pytest.mark.parametrize("distance", [200, 400])
def test_a_far_view_takes_few_gaussians(written: Path, distance: float) -> None:
    """The wall is 30 or 15 pixels wide, and its waves 5 or 2."""
    whole, camera = registry.read(written).gaussians, towards(0, distance)
    with streamed_views.opened(written) as model:
        assert model is not None
        drawn = model.seen_by(camera)
        assert model.tolerance == TOLERANCE
    assert drawn.count < COUNT / 10
    assert psnr(render(drawn, camera, antialias=True).color, render(whole, camera, antialias=True).color) > 32


def test_only_chunks_in_view_are_read_and_they_are_kept(
    written: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with streamed_views.opened(written) as model:
        assert model is not None
        names: list[str] = []
        part = model._document.part

        def counted(name: str) -> Any:
            names.append(name)
            return part(name)

        monkeypatch.setattr(model, "_document", streamed_sog.Document(model._document.index, counted))
        model.seen_by(towards(-15, 3))
        first = [*names]
        assert 0 < len(first) < len(model._names) / 5
        model.seen_by(towards(-15, 3))
        assert names == first
        model.seen_by(towards(15, 3))
        assert not {*names[len(first) :]} & {*first}


def test_less_memory_gives_coarser_views_and_none_is_refused(
    written: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    each = streamed_views.COPIES * reader_memory.parameter_bytes(0)
    with streamed_views.opened(written) as model:
        assert model is not None
        fine = model.seen_by(towards(0, 20)).count
        monkeypatch.setattr(reader_memory, "_limit", each * fine // 2)
        with pytest.raises(ModelUnreadable, match=r"memory, and .* are free"):
            registry.read(written)
        assert model.seen_by(towards(0, 20)).count <= fine // 2
        assert model.tolerance > TOLERANCE
        monkeypatch.setattr(reader_memory, "_limit", 10_000)
        with pytest.raises(ModelUnreadable, match=r"drawing [0-9,]+ of its Gaussians would take"):
            model.seen_by(towards(0, 20))


def test_the_overview_says_what_the_files_say(written: Path, tmp_path: Path) -> None:
    with streamed_views.opened(written) as model:
        assert model is not None
        assert (model.overview.offset, model.overview.antialiased) == ((5.0, 0.0, 0.0), True)
        assert model.overview.gaussians.count <= 1000
    streamed_zip.write(tmp_path / "m.lod.zip", wall().select(slice(500)))
    with streamed_views.opened(tmp_path / "m.lod.zip") as model:
        assert model is not None
        assert model.overview.gaussians.count == model.seen_by(towards(0, 80)).count == 500
    registry.write(tmp_path / "m.ply", wall().select(slice(5)))
    with streamed_views.opened(tmp_path / "m.ply") as model:
        assert model is None


def leaf(index: dict[str, Any]) -> dict[str, Any]:
    node: dict[str, Any] = index["tree"]
    while "children" in node:
        node = node["children"][0]
    return node


CHANGES: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "a run beyond its file": (
        lambda index: leaf(index)["lods"]["0"].update(offset=1999),
        "more Gaussians than the file",
    ),
    "a negative run": (lambda index: leaf(index)["lods"]["1"].update(count=-1), "more Gaussians than"),
    "a file that is not named": (
        lambda index: leaf(index)["lods"]["0"].update(file=10_000),
        "a file that is not among",
    ),
    "a level that is missing": (lambda index: leaf(index)["lods"].pop("1"), "'1'"),
    "a box without a side": (lambda index: leaf(index)["bound"]["min"].pop(), "could not be read"),
    "a box without an end": (
        lambda index: leaf(index)["bound"].update(max=[float("inf")] * 3),
        "not finite",
    ),
    "errors for a level less": (lambda index: leaf(index)["errors"].pop(), "could not be read"),
    "no level": (lambda index: index.update(lodLevels=0), "it has 0 levels"),
    "a number of levels that fills the memory": (lambda index: index.update(lodLevels=10**9), "levels"),
    "a place outside": (
        lambda index: index["filenames"].append("../x/meta.json"),
        "no meta.json in a folder beside it",
    ),
    "a file that is missing": (
        lambda index: index["filenames"].append("x/meta.json"),
        "is missing beside it",
    ),
}


@pytest.mark.parametrize("what", CHANGES)
def test_an_index_that_does_not_fit_is_refused(written: Path, what: str) -> None:
    change, says = CHANGES[what]
    index = json.loads(written.read_bytes())
    change(index)
    odd = written.with_name("odd")
    odd.mkdir(exist_ok=True)
    for folder in written.parent.iterdir():
        if folder.is_dir() and folder != odd and not (odd / folder.name).exists():
            (odd / folder.name).symlink_to(folder)
    (odd / "lod-meta.json").write_text(json.dumps(index))
    with pytest.raises(ModelUnreadable, match=says), streamed_views.opened(odd / "lod-meta.json"):
        pass


def test_levels_of_unknown_errors_are_left_to_those_who_read_all(written: Path) -> None:
    index = json.loads(written.read_bytes())
    kept = written.read_bytes()
    index["lodErrors"] = False
    written.write_text(json.dumps(index))
    try:
        with streamed_views.opened(written) as model:
            assert model is None
    finally:
        written.write_bytes(kept)
