"""Proves `.sog` against splat-transform in both directions, its error bounds, its bytes, and what is refused.

Does not prove what the palette of harmonics costs a trained scene: `splatmill bench formats` measures that.
"""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.splat.formats import ply, registry, sog
from splatmill_worker.splat.gaussians import Gaussians
from tests.support.files.splat_transform import convert
from tests.support.gaussians import differences, matched, some_gaussians


def _few_colors(scene: Gaussians) -> Gaussians:
    """The scene with so few different scales, colours and harmonics that the codebooks of the format hold them all."""
    scene.log_scales[:] = (scene.log_scales * 10).round() / 10
    scene.sh[:, :1] = (scene.sh[:, :1] * 50).round() / 50
    if scene.degree:
        scene.sh[:, 1:] = (scene.sh[:, 1:] * 50).round() / 50
    return scene


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_scene_survives_within_the_steps_of_the_format(tmp_path: Path, degree: int) -> None:
    before = _few_colors(some_gaussians(600, degree))
    assert sog.write(tmp_path / "m.sog", before, offset=(450_000.0, -7.0, 0.0), antialiased=True) == 600
    contents = sog.read(tmp_path / "m.sog")
    assert contents.offset == (450_000.0, -7.0, 0.0)
    assert contents.antialiased is True
    errors = differences(contents.gaussians, matched(contents.gaussians, before))
    reach = before.means.abs().max()
    assert errors["means"] <= float(2 * reach.log1p() / 65535 / 2 * (1 + reach)) * 1.01
    assert errors["quats"] < 3e-5  # three components in steps of sqrt(2) / 255
    assert errors["opacities"] <= 1 / 255 / 2 * 1.01
    assert errors["log_scales"] < 1e-6
    assert errors["dc"] < 1e-6
    assert errors["harmonics"] < 1e-6  # fewer Gaussians than centroids, fewer values than the codebook holds


def test_the_palette_keeps_what_is_seen_better_than_what_is_not(tmp_path: Path) -> None:
    scene = some_gaussians(4000, 2)
    hidden = torch.arange(4000) % 2 == 0
    scene.logit_opacities[:] = torch.where(hidden, -4.0, 4.0)
    sog.write(tmp_path / "m.sog", scene, centroids=512)
    after = sog.read(tmp_path / "m.sog").gaussians
    before = matched(after, scene)
    errors = (after.sh[:, 1:] - before.sh[:, 1:]).square().mean((1, 2))
    spread = float(before.sh[:, 1:].square().mean())
    dim = before.logit_opacities < 0
    assert float(errors[~dim].mean()) < 0.8 * spread
    assert float(errors[~dim].mean()) < 0.9 * float(errors[dim].mean())
    assert len(torch.unique(after.sh[:, 1:].flatten(1), dim=0)) <= 512


def test_splat_transform_reads_what_we_write(tmp_path: Path) -> None:
    sog.write(tmp_path / "ours.sog", some_gaussians(700, 3))
    convert(tmp_path / "ours.sog", tmp_path / "theirs.ply")
    errors = differences(
        ply.read(tmp_path / "theirs.ply").gaussians, registry.read(tmp_path / "ours.sog").gaussians
    )
    assert max(errors.values()) < 1e-5


def test_we_read_what_splat_transform_writes(tmp_path: Path) -> None:
    scene = some_gaussians(300, 1)
    ply.write(tmp_path / "ours.ply", scene)
    convert(tmp_path / "ours.ply", tmp_path / "theirs.sog", "-g", "cpu", "-i", "1")
    after = registry.read(tmp_path / "theirs.sog").gaussians
    errors = differences(after, matched(after, scene))
    assert errors["means"] < 1e-3
    assert errors["quats"] < 1.2e-4  # its bytes are cut off, not rounded
    assert errors["opacities"] <= 1 / 255
    assert errors["log_scales"] < 0.5
    assert errors["dc"] < 0.5


def test_an_unpacked_model_is_the_packed_one(tmp_path: Path) -> None:
    sog.write(tmp_path / "m.sog", some_gaussians(300, 1))
    zipfile.ZipFile(tmp_path / "m.sog").extractall(tmp_path / "folder")
    unpacked = registry.read(tmp_path / "folder/meta.json").gaussians
    for mine, theirs in zip(unpacked, sog.read(tmp_path / "m.sog").gaussians, strict=True):
        assert torch.equal(mine, theirs)


def test_the_same_model_gives_the_same_bytes_and_nothing_is_a_model_too(tmp_path: Path) -> None:
    scene = some_gaussians(2000, 1)
    for name in ("a.sog", "b.sog"):
        sog.write(tmp_path / name, scene, centroids=256)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()
    assert sog.write(tmp_path / "none.sog", scene.select(torch.arange(0))) == 0
    assert sog.read(tmp_path / "none.sog").gaussians.count == 0


def _without_version(meta: dict[str, Any]) -> None:
    del meta["version"]


def _outside(meta: dict[str, Any]) -> None:
    meta["quats"]["files"] = ["../../secret.webp"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_without_version, "version None, and only version 2"),
        (lambda meta: meta.update(count=10**9), "more than 400 times"),
        (lambda meta: meta.update(count=10**5), "pixels for 100000 Gaussians"),
        (lambda meta: meta.update(count=-1), "its count is -1"),
        (lambda meta: meta["scales"].update(codebook=[0.0]), "without 256 finite numbers"),
        (lambda meta: meta["means"].update(mins=[None, 0, 0]), "without 3 finite numbers|could not be read"),
        (lambda meta: meta["shN"].update(bands=7), "7 bands"),
        (lambda meta: meta["shN"].update(bands=3), "palette is"),
        (lambda meta: meta.pop("quats"), "'quats' is missing"),
        (_outside, "secret"),
    ],
)
def test_what_does_not_fit_is_named(
    tmp_path: Path, change: Callable[[dict[str, Any]], Any], says: str
) -> None:
    sog.write(tmp_path / "m.sog", some_gaussians(300, 1))
    zipfile.ZipFile(tmp_path / "m.sog").extractall(tmp_path / "folder")
    meta = json.loads((tmp_path / "folder/meta.json").read_text())
    change(meta)
    (tmp_path / "folder/meta.json").write_text(json.dumps(meta))
    with pytest.raises(ModelUnreadable, match=says):
        registry.read(tmp_path / "folder/meta.json")


def test_damaged_archives_are_named(tmp_path: Path) -> None:
    sog.write(tmp_path / "m.sog", some_gaussians(300, 1))
    data = (tmp_path / "m.sog").read_bytes()
    beyond_the_end = (
        data[:28] + b"\xff\xff" + data[30:]
    )  # the header gives the first member's extra field that length
    list_at = data.index(b"PK\x01\x02")
    encrypted = data[:6] + b"\x01" + data[7 : list_at + 8] + b"\x01" + data[list_at + 9 :]
    half, none, empty = data[: len(data) // 2], b"", b"PK\x05\x06" + b"\0" * 18
    for broken in (half, none, empty, data.replace(b"WEBP", b"WEBQ"), beyond_the_end, encrypted):
        (tmp_path / "m.sog").write_bytes(broken)
        with pytest.raises(ModelUnreadable, match=r"m\.sog"):
            registry.read(tmp_path / "m.sog")
    (tmp_path / "meta.json").write_text("[" * 10**5)
    with pytest.raises(ModelUnreadable, match="nests too many"):
        registry.read(tmp_path / "meta.json")
    with pytest.raises(FileNotFoundError):
        registry.read(tmp_path / "none.sog")


def _with_zip64(path: Path, size: int | None, *, hidden: bool) -> None:
    """Give an archive the record of a large one, which says that its list has `size` bytes; None for the true number.

    hidden: whether the usual record says nothing of it, and names the true number.
    """
    content = path.read_bytes()
    magic, disk, first, here, count, length, start, comment = _LIST_END.unpack(content[-_LIST_END.size :])
    at = len(content) - _LIST_END.size
    record = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, count, count, size or length, start)
    locator = struct.pack("<4sLQL", b"PK\6\7", 0, at, 1)
    shown = (here, count, length, start) if hidden else (0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF)
    path.write_bytes(content[:at] + record + locator + _LIST_END.pack(magic, disk, first, *shown, comment))


_LIST_END = struct.Struct("<4s4H2IH")
"""The record at the end of an archive (APPNOTE.TXT, 4.3.16)."""


def test_an_archive_with_the_record_of_a_large_one_is_read(tmp_path: Path) -> None:
    path = tmp_path / "m.sog"
    sog.write(path, some_gaussians(60, 1))
    before = sog.read(path).gaussians
    _with_zip64(path, None, hidden=False)
    assert torch.equal(sog.read(path).gaussians.means, before.means)


@pytest.mark.parametrize("hidden", [True, False])
def test_a_long_list_is_refused_wherever_its_length_stands(tmp_path: Path, hidden: bool) -> None:
    path = tmp_path / "m.sog"
    sog.write(path, some_gaussians(60, 1))
    with path.open("r+b") as file:  # room before the list, which is cut off of its true length
        content = file.read()
        start = _LIST_END.unpack(content[-_LIST_END.size :])[6]
        file.seek(0)
        file.write(content[:start] + bytes(200_000) + content[start:])
    _with_zip64(path, 200_000, hidden=hidden)
    # Pythons that compare the records of zip64 with each other refuse them before.
    with pytest.raises(ModelUnreadable, match=r"its list of files has 200000 bytes|it is no zip archive"):
        sog.read(path)
