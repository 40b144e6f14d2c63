"""Proves that the figure of a report has room for its labels. Does not prove how it looks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker.splat.report.figure import draw_curve


@pytest.mark.parametrize("most", [900, 250_000, 9_000_000])
@pytest.mark.parametrize("memory", [3e8, 250e9])
def test_no_label_is_cut_off(tmp_path: Path, most: int, memory: float) -> None:
    curve = [
        {
            "seconds": seconds,
            "psnr": 20.0 + share,
            "ssim": 0.8 + share / 100,
            "train_psnr": 21.0 + share,
            "train_ssim": 0.81 + share / 100,
            "gaussians": int(share * most),
            "memory": share * memory,
        }
        for seconds, share in ((0.3, 0.1), (40.0, 0.5), (9000.0, 1.0))
    ]
    draw_curve(tmp_path / "report.png", curve, {"sfm": 3.0, "train": 9000.0})
    with Image.open(tmp_path / "report.png") as picture:
        pixels = np.asarray(picture.convert("L"))
    edges = [pixels[:2], pixels[-2:], pixels[:, :2].T, pixels[:, -2:].T]
    assert [int(edge.min()) for edge in edges] == [255, 255, 255, 255]
