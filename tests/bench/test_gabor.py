"""Proves that `bench gabor` compares equal numbers of parameters, and that its pictures are the same each time.

Not proven here: its figures, and that the page is made from rows (test_studies.py).
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
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
    assert bench.STUDY.main([*quick, "--pictures", "weave"]) == 0
    plain, gabor, longer = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert plain["parameters"] == 9 * plain["gaussians"] == 9 * 144
    assert gabor["parameters"] == 9 * gabor["gaussians"] + 6 * gabor["waves"]
    assert 0 <= plain["parameters"] - gabor["parameters"] < 15
    assert longer["gaussians"] == plain["gaussians"]
    assert not list(tmp_path.iterdir())


def test_a_name_that_is_no_picture_is_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.STUDY.main(["--dry", "--pictures", "horse"]) == 1
    assert "horse is none of the pictures: stripes," in capsys.readouterr().err
