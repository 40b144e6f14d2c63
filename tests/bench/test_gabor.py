"""Proves that `bench gabor` compares equal numbers of parameters, that its pictures are the same each time, and that
waves of the scene in 3D have the right frequency in an image.

Not proven here: its figures, and that the page is made from rows (test_studies.py).
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from _gabor import scene
from _gabor.pictures import PICTURES, picture

bench = importlib.import_module("gabor")


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_is_the_same_each_time_and_no_flat_one(name: str) -> None:
    first = picture(name, 48)
    assert first.shape == (48, 48, 3)
    assert first.dtype == np.uint8
    assert np.array_equal(first, picture(name, 48))
    assert first.std() > 5


def test_rows_compare_equal_numbers_of_parameters(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    quick = ["--side", "48", "--steps", "30", "--pixels", "16", "--dry", "--out", str(tmp_path)]
    assert bench.STUDY.main([*quick, "--only", "pictures", "--pictures", "weave"]) == 0
    plain, gabor, longer = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert plain["parameters"] == 9 * plain["gaussians"] == 9 * 144
    assert gabor["parameters"] == 9 * gabor["gaussians"] + 6 * gabor["waves"]
    assert 0 <= plain["parameters"] - gabor["parameters"] < 15
    assert longer["gaussians"] == plain["gaussians"]
    assert not list(tmp_path.iterdir())


def test_a_name_that_is_no_picture_is_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.STUDY.main(["--dry", "--only", "pictures", "--pictures", "horse"]) == 1
    assert "horse is none of the pictures: stripes," in capsys.readouterr().err


def test_the_frequency_in_the_image_is_that_of_the_wave_on_the_surface() -> None:
    """Of a flat Gaussian on the floor: the phase at a pixel is that at the place of the floor that the pixel shows."""
    views = scene.views(1)
    model = scene._Model(5, torch.Generator().manual_seed(0))
    with torch.no_grad():
        model.groups["means"][0] = torch.tensor([0.3, -0.2, 0.0])
        model.groups["log_scales"][0] = torch.tensor([-1.5, -1.5, -12.0])
        model.groups["quats"][0] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        viewmat, K = views.viewmats[0], views.K
        p = model.project(viewmat, K)
        frequency = torch.tensor([2.0, -1.0, 0.0])
        image = model.carried(p.conics[:1], torch.tensor([0]), viewmat)[0] @ frequency
        step = torch.tensor([0.01, 0.02, 0.0])
        moved = viewmat[:3, :3] @ (model.groups["means"][0] + step) + viewmat[:3, 3]
        offset = (K @ moved)[:2] / moved[2] - p.means2d[0]
    # Linearised, and with 0.3 of the blur against some 100 pixels^2.
    assert float(image @ offset) == pytest.approx(float(frequency @ step), rel=0.05, abs=2e-3)
