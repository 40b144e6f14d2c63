"""Proves that `.splat` and `.ksplat` are read as splat-transform reads them, and what is refused.

Does not prove that files of mkkellogg's own converter are read beyond one fixture of four Gaussians: it needs a
browser, so the larger files are written by the tests.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.splat.formats import ksplat, ply, splat
from tests.support.files.ksplat_files import ksplat as ksplat_file
from tests.support.files.splat_transform import convert
from tests.support.gaussians import differences
from tests.support.paths import DATA

OTHERS = DATA / "splats/minimal"


def columns(n: int, rest: int = 0) -> tuple[np.ndarray, ...]:
    """Means, linear scales, unit quaternions, rgba and harmonics of random Gaussians without symmetry."""
    random = np.random.default_rng(5)
    quats = random.normal(size=(n, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    rgba = random.integers(1, 255, (n, 4), dtype=np.uint8)
    return (
        random.normal(size=(n, 3)),
        np.exp(random.normal(size=(n, 3)) - 3),
        quats,
        rgba,
        random.uniform(-1.5, 1.5, (n, rest)),
    )


def splat_file(n: int) -> bytes:
    means, scales, quats, rgba, _ = columns(n)
    rows = np.zeros(n, splat.ROW)
    rows["mean"], rows["scale"], rows["rgba"] = means, scales, rgba
    rows["quat"] = np.clip(quats * 128 + 128, 0, 255)
    return rows.tobytes()


def test_a_splat_file_is_read_as_others_read_it(tmp_path: Path) -> None:
    (tmp_path / "m.splat").write_bytes(splat_file(80))
    ours = splat.read(tmp_path / "m.splat").gaussians
    convert(tmp_path / "m.splat", tmp_path / "theirs.ply")
    errors = differences(ours, ply.read(tmp_path / "theirs.ply").gaussians)
    assert errors.pop("quats") < 1e-4  # a byte is (b - 128) / 128 here and b / 127.5 - 1 there
    assert max(errors.values()) < 1e-5


@pytest.mark.parametrize(("level", "rest"), [(1, 0), (1, 9), (1, 24), (2, 24)])
def test_a_ksplat_file_is_read_as_others_read_it(tmp_path: Path, level: int, rest: int) -> None:
    scene = columns(83, rest)
    path = tmp_path / "m.ksplat"
    path.write_bytes(ksplat_file(*scene, level=level, sections=2))
    ours = ksplat.read(path).gaussians
    assert np.abs(ours.means.numpy() - scene[0]).max() < 1e-3
    convert(path, tmp_path / "theirs.ply")
    errors = differences(ours, ply.read(tmp_path / "theirs.ply").gaussians)
    assert max(errors.values()) < 1e-5


@pytest.mark.skipif(not OTHERS.is_dir(), reason="needs ../shared/data/splats")
def test_files_of_others_hold_the_same_four_gaussians() -> None:
    first, second = (
        splat.read(OTHERS / "minimal.splat").gaussians,
        ksplat.read(OTHERS / "minimal.ksplat").gaussians,
    )
    assert first.means.tolist() == [[-1, 0, -1], [0, 0, -1], [-1, 0, 0], [0, 0, 0]]
    assert max(differences(first, second).values()) < 1e-6


def test_flat_gaussians_stay_and_broken_ones_go(tmp_path: Path) -> None:
    rows = np.frombuffer(splat_file(4), splat.ROW).copy()
    rows["scale"][0, 1] = 0.0
    rows["scale"][1, 1] = -1.0
    rows["mean"][2, 0] = np.nan
    rows["quat"][3] = 128
    (tmp_path / "m.splat").write_bytes(rows.tobytes())
    contents = splat.read(tmp_path / "m.splat")
    assert contents.gaussians.count == 1
    assert bool(torch.isfinite(contents.gaussians.log_scales).all())
    assert contents.notes == (
        "Gaussians with a value that is not finite, or a quaternion of zeros, are left out: 3 of 4.",
    )


def test_what_is_no_splat_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "m.splat").write_bytes(splat_file(4)[:-1])
    with pytest.raises(ModelUnreadable, match="127 bytes are no whole number of rows"):
        splat.read(tmp_path / "m.splat")


def changed(data: bytes, at: int, form: str, *values: float) -> bytes:
    whole = bytearray(data)
    struct.pack_into(form, whole, at, *values)
    return bytes(whole)


GOOD = ksplat_file(*columns(23, 9), level=1)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"rubbish", "it has 7 bytes"),
        (changed(GOOD, 0, "<B", 3), "its version is 3.1"),
        (changed(GOOD, 4, "<I", 2**32 - 1), "announces 4294967295 sections"),
        (changed(GOOD, 4, "<I", 9), "within its"),
        (changed(GOOD, 20, "<H", 7), "level is 7"),
        (changed(GOOD, 4096 + 40, "<H", 3), "of degree 3"),
        (changed(GOOD, 4096, "<II", 2**32 - 1, 2**32 - 1), "a section of 4294967295 Gaussians ends"),
        (changed(GOOD, 4096, "<I", 24), "a section of 24 Gaussians ends"),
        (changed(GOOD, 4096 + 12, "<I", 2**31), "ends at byte"),
        (changed(GOOD, 4096 + 32, "<I", 99), "100 of 5 buckets"),
        (changed(GOOD, 4096 + 8, "<I", 1), "hold fewer than the 23"),
        (GOOD[:-1], "ends at byte"),
    ],
)
def test_what_is_no_ksplat_file_is_named(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "m.ksplat").write_bytes(content)
    with pytest.raises(ModelUnreadable, match=says):
        ksplat.read(tmp_path / "m.ksplat")


def test_a_ksplat_of_nothing_but_nan_holds_nothing(tmp_path: Path) -> None:
    (tmp_path / "m.ksplat").write_bytes(changed(GOOD, 4096 + 16, "<f", float("nan")))
    assert ksplat.read(tmp_path / "m.ksplat").gaussians.count == 0
