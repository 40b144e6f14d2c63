"""Proves that a `.lod.zip` holds what a `lod-meta.json` names, where viewers look for it, and what is refused.

Does not prove the levels nor their index (test_streamed_sog.py), nor what the page reads (tests/browser/viewer).
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from splatmill.schema.files.formats import is_model_file
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.splat.formats import registry, streamed_zip
from splatmill_worker.splat.gaussians import Gaussians
from tests.support.gaussians import some_gaussians


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    """More Gaussians than the coarsest level may have, so that there are two levels."""
    return some_gaussians(40_000, 0)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, scene: Gaussians) -> Path:
    path = tmp_path_factory.mktemp("scene") / "a/scene.lod.zip"
    assert registry.write(path, scene, offset=(1000.0, 0.0, -2.0), antialiased=True) == 40_000
    return path


def test_it_holds_the_files_of_the_folder_and_nothing_else_is_left(
    tmp_path: Path, written: Path, scene: Gaussians
) -> None:
    registry.write(tmp_path / "lod-meta.json", scene, offset=(1000.0, 0.0, -2.0), antialiased=True)
    beside = {
        path.relative_to(tmp_path).as_posix(): path.read_bytes()
        for path in tmp_path.rglob("*")
        if path.is_file()
    }
    with zipfile.ZipFile(written) as archive:
        assert {name: archive.read(name) for name in archive.namelist()} == beside
    assert [path.name for path in written.parent.iterdir()] == ["scene.lod.zip"]
    assert registry.size(written) == written.stat().st_size


def test_a_chunk_is_one_range_of_bytes_and_the_index_is_the_last_file(written: Path) -> None:
    with zipfile.ZipFile(written) as archive:
        entries = sorted(archive.infolist(), key=lambda entry: entry.header_offset)
    folders = [entry.filename.rpartition("/")[0] for entry in entries]
    assert folders == ["0_0"] * len([name for name in folders if name == "0_0"]) + ["1_0"] * 6 + [""]
    assert entries[-1].filename == "lod-meta.json"
    assert {entry.compress_type for entry in entries[:-1]} == {zipfile.ZIP_STORED}
    assert not any(entry.extra for entry in entries)


def test_it_is_read_back_and_the_same_model_gives_the_same_bytes(
    tmp_path: Path, written: Path, scene: Gaussians
) -> None:
    back = registry.read(written)
    assert (back.gaussians.count, back.offset, back.antialiased) == (40_000, (1000.0, 0.0, -2.0), True)
    registry.write(tmp_path / "again.lod.zip", scene, offset=(1000.0, 0.0, -2.0), antialiased=True)
    assert (tmp_path / "again.lod.zip").read_bytes() == written.read_bytes()
    none = scene.select(torch.arange(0))
    assert registry.write(tmp_path / "none.lod.zip", none) == 0
    assert registry.read(tmp_path / "none.lod.zip").gaussians.count == 0


def test_one_that_somebody_packed_again_is_read(tmp_path: Path, written: Path) -> None:
    again = tmp_path / "again.lod.zip"
    with zipfile.ZipFile(written) as old, zipfile.ZipFile(again, "w", zipfile.ZIP_DEFLATED) as new:
        for name in sorted(old.namelist()):
            new.writestr(f"scene/{name}", old.read(name))
    assert torch.equal(registry.read(again).gaussians.means, registry.read(written).gaussians.means)


def _without(
    begin: str, add: Callable[[zipfile.ZipFile], None] = lambda archive: None
) -> Callable[[Path, Path], None]:
    """What writes the archive again without the files whose names begin so, and with something in their place."""

    def make(written: Path, path: Path) -> None:
        with zipfile.ZipFile(written) as old, zipfile.ZipFile(path, "w") as new:
            for name in old.namelist():
                if not name.startswith(begin):
                    new.writestr(name, old.read(name))
            add(new)

    return make


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda written, path: path.write_bytes(b""), "damaged or cut off"),
        (lambda written, path: path.write_bytes(written.read_bytes()[:-1000]), "damaged or cut off"),
        (lambda written, path: zipfile.ZipFile(path, "w").close(), "it holds no lod-meta.json"),
        (
            _without(
                "lod-meta", lambda new: new.writestr("lod-meta.json", bytes(2**24), zipfile.ZIP_DEFLATED)
            ),
            "has 16777216 bytes, more than",
        ),
        (
            _without("0_0/sh0", lambda new: new.writestr("0_0/sh0.webp", bytes(2**28), zipfile.ZIP_DEFLATED)),
            "sh0.webp has 268435456 bytes, more than",
        ),
        (_without("0_0/meta"), r"0_0/meta\.json is missing"),
        (_without("0_0/quats.webp"), r"quats\.webp is missing"),
    ],
)
def test_what_is_no_such_archive_is_named(
    tmp_path: Path, written: Path, make: Callable[[Path, Path], None], says: str
) -> None:
    path = tmp_path / "odd.lod.zip"
    make(written, path)
    with pytest.raises(ModelUnreadable, match=says):
        registry.read(path)


@pytest.mark.parametrize("folder", ["/etc/", "../../", "a/../b/"])
def test_nothing_outside_of_the_archive_is_read(tmp_path: Path, written: Path, folder: str) -> None:
    path = tmp_path / "in/odd.lod.zip"
    path.parent.mkdir()
    with zipfile.ZipFile(written) as old, zipfile.ZipFile(path, "w") as new:
        new.writestr(f"{folder}lod-meta.json", old.read("lod-meta.json"))
    with pytest.raises(ModelUnreadable, match="is missing in it"):
        registry.read(path)
    assert [each.name for each in tmp_path.rglob("*")] == ["in", "odd.lod.zip"]


def test_a_longer_list_than_is_read_is_refused(tmp_path: Path, written: Path) -> None:
    with pytest.raises(ModelUnreadable, match="more than are read"):
        streamed_zip.read(written, list_bytes=100)
    with pytest.raises(FileNotFoundError):
        registry.read(tmp_path / "none.lod.zip")


def test_no_training_starts_from_one_as_what_is_uploaded_is_unpacked() -> None:
    assert not is_model_file("scene.lod.zip")
    assert is_model_file("scene.sog")
