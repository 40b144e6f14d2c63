"""Proves that the wire's table of formats and the worker's functions agree, and that suffixes choose the format.

Does not prove the formats themselves: each has its own test file.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from splatmill.schema.files.formats import MODEL_FORMATS, format_of
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.splat.formats import compressed_ply, ply, registry
from tests.support.gaussians import some_gaussians


def test_the_table_of_formats_says_what_can_be_read_and_written() -> None:
    assert list(registry.CODECS) == list(MODEL_FORMATS)
    for suffix, form in MODEL_FORMATS.items():
        codec = registry.CODECS[suffix]
        assert (codec.read is not None, codec.write is not None) == (form.readable, form.writable), suffix
        assert (codec.files is not None) == form.folder, suffix
        assert form.suffix == suffix == suffix.lower()
        assert form.loses.endswith(".")


def test_the_longest_suffix_counts_in_any_case() -> None:
    compressed = format_of("Scene.Compressed.PLY")
    assert compressed is not None
    assert compressed.suffix == ".compressed.ply"
    assert format_of("scene.obj") is None
    streamed = format_of("lod-meta.json")
    assert streamed is not None
    assert streamed.folder
    assert format_of("my-lod-meta.json") is None


def test_a_compressed_ply_is_read_under_either_suffix(tmp_path: Path) -> None:
    scene = some_gaussians(20, 1)
    compressed_ply.write(tmp_path / "m.ply", scene)
    assert registry.read(tmp_path / "m.ply").gaussians.count == 20
    ply.write(tmp_path / "m.compressed.ply", scene)
    assert registry.read(tmp_path / "m.compressed.ply").gaussians.degree == 1


@pytest.mark.parametrize("suffix", [suffix for suffix, form in MODEL_FORMATS.items() if form.writable])
def test_every_format_that_is_written_holds_all_visible_gaussians(tmp_path: Path, suffix: str) -> None:
    scene = some_gaussians(300, 2)
    scene.logit_opacities[:10] = -20.0
    path = tmp_path / (f"scene{suffix}" if suffix.startswith(".") else suffix)
    assert registry.write(path, scene, antialiased=True) == 290
    if registry.CODECS[suffix].read is not None:
        assert registry.read(path).gaussians.count == 290


def test_an_unknown_suffix_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ModelUnreadable, match=r"not read. Those that are: \.ply, \.compressed\.ply"):
        registry.read(tmp_path / "scene.obj")
    with pytest.raises(ModelUnreadable, match=r"not written. Those that are: \.ply, \.compressed\.ply"):
        registry.write(tmp_path / "scene.obj", some_gaussians(1, 0))
