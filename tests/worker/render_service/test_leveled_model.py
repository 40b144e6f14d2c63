"""Proves that views of a model in levels of detail read what they draw, within bounds of error and memory.

Does not prove the choice of levels (tests/worker/splat/lod/test_choice.py), nor how the levels are made.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.readers import reader_memory
from splatmill_worker.render_service import leveled_model
from splatmill_worker.render_service.encoding import camera_of
from splatmill_worker.render_service.local import loaded, overview
from splatmill_worker.scene import Camera
from splatmill_worker.splat.formats import registry, streamed_sog, streamed_zip
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from splatmill_worker.splat.lod.choice import TOLERANCE
from splatmill_worker.splat.lod.levels import make_levels
from splatmill_worker.splat.render import render
from tests.support.decoding.reader_peak import peaks
from tests.support.gaussians import some_gaussians

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


def psnr(image: torch.Tensor, expected: torch.Tensor) -> float:
    return float(-10 * torch.log10((image - expected).square().mean()))


@pytest.mark.parametrize(("x", "distance"), [(0, 3), (12, 3), (0, 12), (-15, 12)])
def test_a_near_view_is_that_of_all_gaussians_and_takes_those_in_view(
    written: Path, x: float, distance: float
) -> None:
    whole, camera = registry.read(written).gaussians, towards(x, distance)
    with leveled_model.opened(written) as model:
        assert model is not None
        drawn = model.seen_by(camera)
    assert drawn.count < COUNT / 2
    expected = render(whole, camera, antialias=True)
    torch.testing.assert_close(render(drawn, camera, antialias=True).color, expected.color, rtol=0, atol=1e-5)


@pytest.mark.parametrize("distance", [200, 400])
def test_a_far_view_takes_few_gaussians(written: Path, distance: float) -> None:
    """The wall is 30 or 15 pixels wide, and its waves 5 or 2."""
    whole, camera = registry.read(written).gaussians, towards(0, distance)
    with leveled_model.opened(written) as model:
        assert model is not None
        drawn = model.seen_by(camera)
        assert model.tolerance == TOLERANCE
    assert drawn.count < COUNT / 10
    assert psnr(render(drawn, camera, antialias=True).color, render(whole, camera, antialias=True).color) > 32


def test_only_chunks_in_view_are_read_and_they_are_kept(
    written: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with leveled_model.opened(written) as model:
        assert model is not None
        names: list[str] = []
        part = model._part

        def counted(name: str) -> Any:
            names.append(name)
            return part(name)

        monkeypatch.setattr(model, "_part", counted)
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
    with leveled_model.opened(written) as model:
        assert model is not None
        fine = model.seen_by(towards(0, 20)).count
    monkeypatch.setattr(reader_memory, "_limit", 3 * 10**6)
    with pytest.raises(ModelUnreadable, match=r"memory, and .* are free"):
        registry.read(written)
    with leveled_model.opened(written) as model:
        assert model is not None
        assert model.seen_by(towards(0, 20)).count < fine
        assert model.tolerance > TOLERANCE
        monkeypatch.setattr(
            reader_memory, "_limit", 10**6
        )  # other programs have taken memory since it was opened
        assert 0 < model.seen_by(towards(0, 20)).count < 10**6 // (3 * 56)
        monkeypatch.setattr(reader_memory, "_limit", 10_000)
        with pytest.raises(ModelUnreadable, match=r"drawing [0-9,]+ of its Gaussians would take"):
            model.seen_by(towards(0, 20))


def test_views_take_no_more_memory_than_they_may(written: Path) -> None:
    ((size, said),) = peaks(f"{__name__}:draw", [written, written])
    assert said == "read"
    assert size < MEMORY + DRAWING


MEMORY = 10 * 10**6
"""Bytes that the views of `draw` may take."""

DRAWING = 12 * 10**6
"""Bytes that a picture of 160 x 120 pixels takes, and that the allocator keeps."""


def draw(path: Path) -> None:
    """Draw views of all of the wall from near to far, for the measurement of memory in a process of its own."""
    reader_memory.set_limit(MEMORY)
    with leveled_model.opened(path) as model, torch.no_grad():
        assert model is not None
        for distance in (3, 40, 20, 80, 12):
            render(model.seen_by(towards(0, distance)), towards(0, distance))


def test_the_overview_says_what_the_files_say(written: Path, tmp_path: Path) -> None:
    with leveled_model.opened(written) as model:
        assert model is not None
        assert (model.overview.offset, model.overview.antialiased) == ((5.0, 0.0, 0.0), True)
        assert model.overview.gaussians.count <= 1000
    streamed_zip.write(tmp_path / "m.lod.zip", wall().select(slice(500)))
    with leveled_model.opened(tmp_path / "m.lod.zip") as model:
        assert model is not None
        assert model.overview.gaussians.count == model.seen_by(towards(0, 80)).count == 500
    registry.write(tmp_path / "m.ply", wall().select(slice(5)))
    with leveled_model.opened(tmp_path / "m.ply") as model:
        assert model is None


def leaf(index: dict[str, Any]) -> dict[str, Any]:
    node: dict[str, Any] = index["tree"]
    while "children" in node:
        node = node["children"][0]
    return node


UNUSABLE: dict[str, Callable[[dict[str, Any]], object]] = {
    "unknown errors": lambda index: index.update(lodErrors=False),
    "a run beyond its file": lambda index: leaf(index)["lods"]["1"].update(offset=1999),
    "a run at the end of all numbers": lambda index: leaf(index)["lods"]["1"].update(offset=2**63 - 1),
    "a negative run": lambda index: leaf(index)["lods"]["1"].update(count=-1),
    "a count that is none": lambda index: leaf(index)["lods"]["1"].update(count=1.5),
    "a file that is not named": lambda index: leaf(index)["lods"]["1"].update(file=10_000),
    "a level that is missing": lambda index: leaf(index)["lods"].pop("1"),
    "a box without a side": lambda index: leaf(index)["bound"]["min"].pop(),
    "a box without an end": lambda index: leaf(index)["bound"].update(max=[float("inf")] * 3),
    "an error that is not a number": lambda index: leaf(index).update(errors=[float("nan")] * 4),
    "errors for a level less": lambda index: leaf(index)["errors"].pop(),
    "no level": lambda index: index.update(lodLevels=0),
    "a number of levels that fills the memory": lambda index: index.update(lodLevels=10**9),
    "a coarse file that is missing": lambda index: index["filenames"].__setitem__(
        leaf(index)["lods"]["1"]["file"], "x/meta.json"
    ),
}
"""Changes of an index after which level 0 is still to be read."""


def changed(written: Path, folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """The model with another index."""
    index = json.loads(written.read_bytes())
    change(index)
    for part in written.parent.iterdir():
        if part.is_dir():
            (folder / part.name).symlink_to(part)
    (folder / "lod-meta.json").write_text(json.dumps(index))
    return folder / "lod-meta.json"


@pytest.mark.parametrize("what", UNUSABLE)
def test_levels_that_cannot_be_chosen_are_left_to_those_who_read_all(
    written: Path, tmp_path: Path, what: str
) -> None:
    path = changed(written, tmp_path, UNUSABLE[what])
    with leveled_model.opened(path) as model:
        assert model is None
    with loaded(path) as whole:
        assert whole.gaussians.count == COUNT


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda index: index.update(version=2), "its version is 2, and only version 1 is read"),
        (
            lambda index: index["filenames"].__setitem__(0, "../x/meta.json"),
            "no meta.json in a folder beside it",
        ),
        (
            lambda index: index["filenames"].__setitem__(0, "x/meta.json"),
            "x/meta.json, which is missing beside it",
        ),
        (lambda index: index.pop("tree"), "could not be read"),
    ],
    ids=["version", "outside", "missing", "no tree"],
)
def test_what_cannot_be_read_at_all_is_refused_with_the_reason(
    written: Path, tmp_path: Path, change: Callable[[dict[str, Any]], object], says: str
) -> None:
    path = changed(written, tmp_path, change)
    with pytest.raises(ModelUnreadable, match=says), loaded(path):
        pass


@pytest.mark.parametrize("name", ["lod-meta.json", "m.lod.zip"])
def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path, name: str) -> None:
    with pytest.raises(FileNotFoundError), loaded(tmp_path / name):
        pass
    os.mkfifo(tmp_path / name)
    with pytest.raises(ModelUnreadable, match="not a regular file"), loaded(tmp_path / name):
        pass


def test_a_leaf_that_is_drawn_over_and_over_fills_no_memory(written: Path, tmp_path: Path) -> None:
    def repeat(index: dict[str, Any]) -> None:
        index["tree"] = {"children": [leaf(index)] * 15_000}

    with leveled_model.opened(changed(written, tmp_path, repeat)) as model:
        assert model is not None
        middle = np.mean(
            [leaf(json.loads(written.read_bytes()))["bound"][side] for side in ("min", "max")], 0
        )
        camera = towards(float(middle[0]), 3).moved_to(middle - [0, 0, 3])
        with pytest.raises(ModelUnreadable, match="made to fill the memory"):
            model.seen_by(camera)


def test_a_chunk_that_is_damaged_later_is_named(written: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(written.parent, copy)
    with loaded(copy / "lod-meta.json") as model:
        for image in copy.glob("0_*/means_l.webp"):
            image.write_bytes(b"RIFF")
        with pytest.raises(ModelUnreadable, match=r"(cannot|could not) be read"):
            model.seen_by(towards(0, 3))


def test_leaves_without_children_are_leaves(written: Path, tmp_path: Path) -> None:
    path = changed(written, tmp_path, lambda index: leaf(index).update(children=[]))
    with leveled_model.opened(path) as model, leveled_model.opened(written) as before:
        assert model is not None
        assert before is not None
        assert model.seen_by(towards(0, 30)).count == before.seen_by(towards(0, 30)).count


def test_an_orbit_looks_at_the_scene_and_not_at_its_surroundings(tmp_path: Path) -> None:
    """2,000 Gaussians of the coarsest level stand for 60,000, and 3,000 far ones for themselves."""
    shell = some_gaussians(3000, 0)
    shell.means[:] = 100 * torch.nn.functional.normalize(shell.means + torch.tensor([1.0, 0, 0]), dim=1)
    scene = concatenate(wall(), shell)
    levels = make_levels(scene, coarsest=2000, leaf=1000)
    assert levels.surroundings is not None
    streamed_sog.write_levels(tmp_path / "lod-meta.json", levels)
    registry.write(tmp_path / "m.ply", scene)
    up = np.array([0.0, -1.0, 0.0])
    eyes = []
    for name in ("m.ply", "lod-meta.json"):
        with loaded(tmp_path / name) as model:
            eyes.append(camera_of(overview(model, 64, up)).center)
    np.testing.assert_allclose(eyes[1], eyes[0], atol=3.0)
