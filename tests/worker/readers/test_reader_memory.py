"""Proves that reading a model takes as much memory as is promised, and a file made to fill the memory next to none.

Measured in processes of their own, by the kernel's peak. Does not prove how long reading takes.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from splatmill_worker.readers import reader_memory
from splatmill_worker.splat.formats import palette, ply, registry, streamed_sog
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.lod.levels import divide
from tests.support.decoding.reader_peak import peaks
from tests.support.files.ksplat_files import ksplat
from tests.support.gaussians import some_gaussians
from tests.support.hostile import model_bombs

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="peaks are read from /proc"),
]

MOST_GROWTH = 100 * 10**6
"""Bytes that a refused file may take, by the kernel's count."""

KEPT_FREE = 16 * 10**6
"""Bytes that the allocator may keep between one part of a model and the next: a busy machine took 66 million where 58
million are usual. A second copy of the model would take 35 million."""


def read(paths: list[Path]) -> list[tuple[int, str]]:
    return peaks("splatmill_worker.splat.formats.registry:read", paths)


def test_a_file_made_to_fill_the_memory_takes_next_to_none(tmp_path: Path) -> None:
    registry.write(tmp_path / "small.ply", some_gaussians(3, 1))
    paths = [tmp_path / "small.ply"]
    for index, (suffix, made) in enumerate(model_bombs.MODELS.values()):
        paths.append(tmp_path / f"{index}{suffix}")
        paths[-1].write_bytes(made())
    for what, (size, said) in zip(model_bombs.MODELS, read(paths), strict=True):
        assert said != "read", what
        assert size < MOST_GROWTH, (what, size, said)


COUNT = 150_000


def gaussians(degree: int) -> Gaussians:
    """Many Gaussians, one of which is not finite, so that the reader copies the others."""
    made = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=made)

    return Gaussians(
        normal(COUNT, 3),
        normal(COUNT, 3) - 4,
        normal(COUNT, 4),
        normal(COUNT) + 2,
        normal(COUNT, (degree + 1) ** 2, 3) / 10,
    )


def any_palette(
    rows: torch.Tensor, weights: torch.Tensor, size: int, seed: int = 0
) -> tuple[torch.Tensor, torch.Tensor]:
    """A palette of the size that the writer of `.sog` asks for, with random labels: to search a good one takes long."""
    made = torch.Generator().manual_seed(seed)
    return rows[:size], torch.randint(size, (len(rows),), generator=made)


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_a_reader_takes_no_more_than_its_copies(
    tmp_path: Path, degree: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The files have as many bytes to be read as ever, whatever the palette of the `.sog` holds."""
    monkeypatch.setattr(palette, "palette", any_palette)
    whole = gaussians(degree)
    registry.write(tmp_path / "small.ply", some_gaussians(3, 1))
    paths = [tmp_path / "small.ply"]
    for suffix in (".ply", ".compressed.ply", ".spz", ".glb", ".sog"):
        paths.append(tmp_path / f"m{suffix}")
        registry.write(paths[-1], whole)
    content = bytearray((tmp_path / "m.ply").read_bytes())
    content[-4:] = b"\xff" * 4  # a part of a quaternion is NaN
    (tmp_path / "m.ply").write_bytes(content)
    if degree == 0:
        paths.append(tmp_path / "m.splat")
        paths[-1].write_bytes(np.random.default_rng(1).integers(0, 120, 32 * COUNT, np.uint8).tobytes())
    if degree == 2:
        paths.append(tmp_path / "m.ksplat")
        part = whole.select(torch.arange(COUNT // 10))
        rest = part.sh[:, 1:].transpose(1, 2).flatten(1).numpy()
        rgba = np.full((part.count, 4), 99, np.uint8)
        values = (part.means.numpy(), part.log_scales.exp().numpy(), part.quats.numpy(), rgba, rest)
        paths[-1].write_bytes(ksplat(*values, level=1))
    parameters = COUNT * reader_memory.parameter_bytes(degree)
    for path, (size, said) in zip(paths[1:], read(paths), strict=True):
        assert said == "read", (path.name, said)
        copies = ply.COPIES if path.name == "m.ply" else reader_memory.COPIES
        assert size < copies * parameters, (path.name, size / parameters)


@pytest.mark.parametrize("chunk", [16_384, COUNT // 2])
def test_levels_of_detail_are_read_a_part_at_a_time(
    tmp_path: Path, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parts of a tenth of the model, and of a half."""
    monkeypatch.setattr(palette, "palette", any_palette)
    registry.write(tmp_path / "small.ply", some_gaussians(3, 1))
    index = tmp_path / "lod-meta.json"
    streamed_sog.write_levels(index, divide(gaussians(3)), chunk=chunk)
    ((size, said),) = read([tmp_path / "small.ply", index])
    assert said == "read"
    promised = reader_memory.parameter_bytes(3) * (COUNT + reader_memory.COPIES * chunk)
    assert size < promised + KEPT_FREE


def test_a_reader_of_degree_4_takes_no_more_than_its_copies(tmp_path: Path) -> None:
    registry.write(tmp_path / "small.ply", some_gaussians(3, 1))
    registry.write(tmp_path / "three.ply", gaussians(3))
    rows = PlyData.read(str(tmp_path / "three.ply"))["vertex"].data
    names = [f"f_rest_{i}" for i in range(72)]
    others = [name for name in rows.dtype.names if not name.startswith("f_rest")]
    table = np.zeros(COUNT, [(name, "<f4") for name in (*others, *names)])
    for name in others:
        table[name] = rows[name]
    table["x"][0] = np.nan
    PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(str(tmp_path / "four.ply"))
    ((size, said),) = read([tmp_path / "small.ply", tmp_path / "four.ply"])
    assert said == "read"
    assert size < ply.COPIES * 4 * COUNT * (11 + 3 * 25)


def test_a_model_larger_than_the_memory_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader_memory, "_limit", 10**6)
    registry.write(tmp_path / "m.ply", some_gaussians(2000, 3))
    with pytest.raises(Exception, match=r"take 1\.4 MB of memory, and 1\.0 MB are free"):
        registry.read(tmp_path / "m.ply")
