"""Photos that were written to a file are read as they were, and a file that is not whole is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from splatmill_worker.scene import Camera
from splatmill_worker.splat.views import Target, TrainingView
from splatmill_worker.tiles.photo_file import read_photos, write_photos


def photo(name: str, width: int, height: int, *, alpha: bool, mask: bool) -> TrainingView:
    """A photo of noise, whose camera is no round number."""
    random = torch.Generator().manual_seed(width)

    def noise(*shape: int) -> torch.Tensor:
        return torch.randint(0, 256, shape, generator=random, dtype=torch.uint8)

    viewmat = np.eye(4)
    viewmat[:3, 3] = np.array([0.1, 2.0 / 3.0, float(width)])
    camera = Camera(width, height, 100.0 / 3.0, 33.0, width / 2 + 0.1, height / 2, viewmat)
    wide = noise(height, 2 * width, 3)[:, ::2]  # not contiguous
    return TrainingView(
        name,
        {
            1: Target.of(
                camera,
                wide,
                noise(height, width) if alpha else None,
                noise(height, width) > 100 if mask else None,
            )
        },
    )


def test_photos_are_read_as_they_were_written(tmp_path: Path) -> None:
    views = [
        photo("a.jpg", 7, 5, alpha=False, mask=False),
        photo("b/ü x.png", 4, 9, alpha=True, mask=False),
        photo("c.png", 8, 3, alpha=True, mask=True),
        photo("d.jpg", 5, 5, alpha=False, mask=True),
    ]
    write_photos(tmp_path / "training", views)
    read = read_photos(tmp_path / "training")
    assert [view.name for view in read] == [view.name for view in views]
    for copy, original in zip(read, views, strict=True):
        cameras = [each.full.camera for each in (copy, original)]
        assert len({(camera.width, camera.height) for camera in cameras}) == 1
        for matrix in ("viewmat", "K"):
            assert np.array_equal(*(getattr(camera, matrix) for camera in cameras))
        for name in ("viewmat", "K", "rgb", "alpha", "mask"):
            one, other = (getattr(each.full, name) for each in (copy, original))
            assert (one is None) == (other is None)
            assert one is None or (one.dtype == other.dtype and torch.equal(one, other))
    write_photos(tmp_path / "held-out", [])
    assert read_photos(tmp_path / "held-out") == ()


@pytest.mark.parametrize("change", [-1, 1])
def test_a_file_of_another_length_is_refused(tmp_path: Path, change: int) -> None:
    write_photos(tmp_path / "training", [photo("a.jpg", 7, 5, alpha=False, mask=True)])
    path = tmp_path / "training.bin"
    data = path.read_bytes()
    path.write_bytes(data[:change] if change < 0 else data + b"x")
    with pytest.raises(ValueError, match=f"has {140 + change} bytes; its photos have 140"):
        read_photos(tmp_path / "training")
