"""Proves that the held-out photos of a model are, pixel by pixel, what was compared with, and that the bound
on their bytes is kept and said.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatmill_worker.splat.report import held_out
from splatmill_worker.splat.views import TrainingView
from tests.support import still_life

GREY = torch.tensor([0.2, 0.4, 0.6])


def masked(view: TrainingView) -> TrainingView:
    mask = torch.ones(view.full.rgb.shape[:2], dtype=torch.bool)
    mask[:10, :20] = False
    return replace(view, levels={1: view.full._replace(mask=mask)})


def test_the_files_hold_the_compared_pixels(tmp_path: Path) -> None:
    opaque, transparent = still_life.training_views()[0], still_life.training_views(alpha=True)[1]
    views = [opaque, masked(transparent)]
    files, missing = held_out.write_held_out(tmp_path, views, GREY)
    assert files == {opaque.name: "held_out/000.webp", transparent.name: "held_out/001.webp"}
    assert not missing
    for view in views:
        with Image.open(tmp_path / files[view.name]) as picture:
            assert picture.format == "WEBP"
            pixels = np.asarray(picture)
        assert (pixels[..., :3] == view.full.over(GREY).numpy()).all()
        if view.full.mask is not None:
            assert ((pixels[..., 3] == 255) == view.full.mask.numpy()).all()


def test_a_bound_leaves_out_the_rest_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views = still_life.training_views()[:3]
    held_out.write_held_out(tmp_path, views, GREY)
    sizes = [path.stat().st_size for path in sorted((tmp_path / "held_out").iterdir())]
    monkeypatch.setattr(held_out, "MOST_BYTES", sizes[0] + sizes[1])
    files, missing = held_out.write_held_out(tmp_path, views, GREY)
    assert list(files) == [views[0].name, views[1].name]
    assert sorted(path.name for path in (tmp_path / "held_out").iterdir()) == ["000.webp", "001.webp"]
    [(name, reason)] = missing
    assert name == views[2].name
    assert "fill the" in reason


def test_without_held_out_photos_there_is_no_folder(tmp_path: Path) -> None:
    assert held_out.write_held_out(tmp_path, [], GREY) == ({}, [])
    assert not list(tmp_path.iterdir())
