"""Proves `.spz` against the library of the format in both directions and all versions, its frame, and what is refused.

Does not prove how a converted model looks: tests of the command `convert` measure that. Files of Scaniverse itself are
not at hand; those in ../shared/data are of Niantic's library and of SuperSplat.
"""

from __future__ import annotations

import gzip
import struct
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.scene import Camera
from splatmill_worker.splat.formats import ply, registry, spz
from splatmill_worker.splat.formats.frames import turned_about_x
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.render import render
from tests.support.files import niantic_spz
from tests.support.files.splat_transform import convert
from tests.support.gaussians import differences, matched, some_gaussians
from tests.support.hostile.archives import gzip_of_zeros
from tests.support.paths import DATA

OTHERS = DATA / "splats"


def within_one(scene: Gaussians) -> Gaussians:
    """The scene with harmonics that the format can hold."""
    return Gaussians(
        scene.means,
        scene.log_scales,
        scene.quats,
        scene.logit_opacities,
        torch.cat([scene.sh[:, :1], scene.sh[:, 1:].clamp(-0.9, 0.9)], dim=1),
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("bits", [4, 6, 8])
def test_a_scene_survives_within_the_steps_of_the_format(tmp_path: Path, degree: int, bits: int) -> None:
    before = within_one(some_gaussians(400, degree))
    assert spz.write(tmp_path / "m.spz", before, sh_bits=bits, antialiased=True) == 400
    contents = spz.read(tmp_path / "m.spz")
    assert contents.antialiased is True
    errors = differences(contents.gaussians, matched(contents.gaussians, before))
    smallest = float(before.log_scales.amax(dim=1).exp().min())
    assert errors["means"] <= smallest / 20
    assert errors["log_scales"] <= 1 / 32 + 1e-6
    assert errors["quats"] < 4e-6
    assert errors["opacities"] <= 0.5 / 255 + 1e-6
    assert errors["dc"] <= 0.5 / 255 / 0.15 + 1e-6
    assert errors["harmonics"] <= 2**-bits + 1e-6


def test_a_scene_far_out_gets_fewer_bits_after_the_point(tmp_path: Path) -> None:
    before = some_gaussians(100, 0)
    before.means[5, 2] = -9_000.0
    spz.write(tmp_path / "m.spz", before)
    after = spz.read(tmp_path / "m.spz").gaussians
    assert float(after.means.min()) == -9_000.0
    assert float((after.means - matched(after, before).means).abs().max()) <= 2**-10


@pytest.mark.parametrize("unit", [1e-3, 1.0, 300.0])
def test_positions_are_as_fine_as_the_gaussians_are_small(tmp_path: Path, unit: float) -> None:
    before = some_gaussians(200, 0).moved(unit, torch.zeros(3))
    spz.write(tmp_path / "m.spz", before)
    after = spz.read(tmp_path / "m.spz").gaussians
    difference = (after.means - matched(after, before).means).abs().max()
    assert float(difference / before.log_scales.amax(dim=1).exp().quantile(0.01)) <= 1 / 40 * 1.5


def test_the_turn_about_x_changes_no_view() -> None:
    """The turned scene from the turned camera is the same picture, harmonics included."""
    scene = some_gaussians(200, 3)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    viewmat[:3, :3] *= np.linalg.det(viewmat[:3, :3])
    viewmat[:3, 3] = (0.3, -0.2, 5.0)
    camera = Camera(48, 40, 60.0, 55.0, 23.0, 21.0, viewmat)
    turned = replace(camera, viewmat=viewmat @ np.diag([1.0, -1.0, -1.0, 1.0]))
    background = torch.zeros(3)
    first = render(scene, camera, background=background).color
    second = render(turned_about_x(scene), turned, background=background).color
    assert float(first.std()) > 0.05
    assert float((first - second).abs().max()) < 1e-4
    again = turned_about_x(turned_about_x(scene))
    assert all(torch.equal(a, b) for a, b in zip(again, scene, strict=True))


def test_the_library_of_the_format_reads_what_we_write(tmp_path: Path) -> None:
    spz.write(tmp_path / "ours.spz", some_gaussians(300, 3), antialiased=True)
    theirs, antialiased = niantic_spz.read(tmp_path / "ours.spz")
    assert antialiased
    assert max(differences(theirs, spz.read(tmp_path / "ours.spz").gaussians).values()) < 1e-5


@pytest.mark.parametrize(("version", "bits"), [(2, 8), (3, 6), (4, 5)])
def test_we_read_what_the_library_of_the_format_writes(tmp_path: Path, version: int, bits: int) -> None:
    before = within_one(some_gaussians(300, 3))
    niantic_spz.write(tmp_path / "theirs.spz", before, version=version, bits=bits)
    contents = spz.read(tmp_path / "theirs.spz")
    errors = differences(contents.gaussians, matched(contents.gaussians, before))
    assert contents.antialiased
    assert errors["means"] < 2e-4
    assert errors["quats"] < (4e-6 if version > 2 else 5e-3)
    assert errors["dc"] < 0.015
    assert errors["harmonics"] <= 2**-bits * 1.5


def test_splat_transform_reads_what_we_write_without_the_turn(tmp_path: Path) -> None:
    """From its version 3 it takes the frame of an .spz for that of a .ply."""
    spz.write(tmp_path / "ours.spz", some_gaussians(300, 2))
    convert(tmp_path / "ours.spz", tmp_path / "theirs.ply")
    theirs = turned_about_x(ply.read(tmp_path / "theirs.ply").gaussians)
    assert max(differences(theirs, spz.read(tmp_path / "ours.spz").gaussians).values()) < 1e-5


@pytest.mark.skipif(not OTHERS.is_dir(), reason="needs ../shared/data/splats")
def test_files_of_all_versions_are_read() -> None:
    """The fixtures hold four Gaussians with a distance of 1; that of version 2 was made in another frame."""
    three, four = (spz.read(OTHERS / "minimal" / f"minimal-v{v}.spz").gaussians for v in (3, 4))
    assert all(torch.equal(a, b) for a, b in zip(three, four, strict=True))
    assert three.means.abs().tolist() == [[1, 0, 1], [0, 0, 1], [1, 0, 0], [0, 0, 0]]
    assert torch.allclose(torch.sigmoid(three.logit_opacities), torch.tensor(230 / 255))
    two, raw = (spz.read(OTHERS / "minimal" / f"minimal-{v}.spz").gaussians for v in ("v2", "raw"))
    assert all(torch.equal(a, b) for a, b in zip(two, raw, strict=True))
    assert torch.allclose(two.quats[:, 0], torch.ones(4), atol=1e-4)
    biker = spz.read(OTHERS / "biker.spz").gaussians
    packed = registry.read(OTHERS / "biker.compressed.ply").gaussians
    assert biker.count == packed.count == 152_746
    assert torch.allclose(biker.means.mean(dim=0), packed.means.mean(dim=0), atol=1e-3)


def header(count: int, *, version: int = 3, degree: int = 0, bits: int = 12) -> bytes:
    return b"NGSP" + struct.pack("<IIBBBB", version, count, degree, bits, 0, 0)


def test_harmonics_of_degree_4_are_left_out_and_said(tmp_path: Path) -> None:
    steps = np.full((5, 24, 3), 255, np.uint8)
    steps[:, :15] = np.arange(5 * 15 * 3, dtype=np.uint8).reshape(5, 15, 3)
    rows = bytes(9 * 5) + bytes([255] * 5) + bytes(6 * 5) + bytes([0, 0, 0, 192] * 5)
    (tmp_path / "m.spz").write_bytes(gzip.compress(header(5, degree=4) + rows + steps.tobytes()))
    contents = spz.read(tmp_path / "m.spz")
    assert contents.notes == ("Its harmonics of degree 4 are read to degree 3.",)
    rest = torch.from_numpy(steps[:, :15].astype(np.float32) - 128) / 128
    assert torch.equal(contents.gaussians.sh[:, 1:].abs(), rest.abs())


def fourth(count: int, *frames: bytes, streams: int | None = None, sizes: list[int] | None = None) -> bytes:
    """A file of version 4 without harmonics."""
    expected = [width * count for width in (9, 1, 3, 3, 4)] if sizes is None else sizes
    table = b"".join(struct.pack("<QQ", len(f), s) for f, s in zip(frames, expected, strict=True))
    head = header(count, version=4)[:15] + bytes([len(frames) if streams is None else streams])
    return head + struct.pack("<I12x", 32) + table + b"".join(frames)


def frames(count: int) -> list[bytes]:
    return [zstandard.compress(bytes(width * count)) for width in (9, 1, 3, 3, 4)]


zipped = partial(gzip.compress, mtime=0)
"""Without the time in the header: the contents name the cases, which every process must name alike."""


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "does not begin with 'NGSP'"),
        (b"rubbish" * 9, "does not begin with 'NGSP'"),
        (zipped(b"rubbish" * 9), "does not begin with 'NGSP'"),
        (zipped(header(4) + bytes(80))[:-12], "gzip data end"),
        (b"\x1f\x8b" + b"rubbish" * 9, "gzip data are damaged"),
        (zipped(header(4, version=9) + bytes(80)), "its version is 9"),
        (zipped(header(4, degree=7) + bytes(80)), "of degree 7"),
        (zipped(header(4, bits=200) + bytes(80)), "200 of 24 bits"),
        (zipped(header(4) + bytes(40)), "end after 0 of 12 bytes"),
        (zipped(header(2**32 - 1) + bytes(40)), "4,294,967,295 Gaussians would take"),
        (gzip_of_zeros(header(10**7), 200), "more than 400 times"),
        (header(4) + bytes(40), "too early"),
        (fourth(4, *frames(4))[:100], "table of streams|too early"),
        (fourth(4, *frames(4), streams=6), "6 streams, where 5"),
        (fourth(4, *frames(4), sizes=[36, 4, 12, 12, 10**12]), "where \\[36, 4, 12, 12, 16\\] are needed"),
        (fourth(4, *frames(5), sizes=[36, 4, 12, 12, 16]), "more than 36 bytes"),
        (fourth(4, *frames(3), sizes=[36, 4, 12, 12, 16]), "fewer than 36 bytes"),
        (fourth(4, *[b"rubbish"] * 5), "zstd data are damaged"),
        (header(4, version=4)[:16], "within its header"),
    ],
)  # fmt: skip
def test_what_is_no_spz_file_is_named(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "bad.spz").write_bytes(content)
    with pytest.raises(ModelUnreadable, match=says):
        spz.read(tmp_path / "bad.spz")
