"""Cut-outs (RGBA photos) with exact cameras and no points start from points inside their outlines, not at random.

Does not prove the gain on real photos, nor what a hull is: tests/worker/splat/start/test_hull.py does.
"""

from __future__ import annotations

import pytest

from tests.inputs.conftest import Build, Train

RIGHT = 33.0
"""Held-out PSNR in dB after 600 steps, with points or without cameras; 22.8 from a random start."""

SPREAD = 1.5
"""Decibels below it that pass: seeds and numbers of threads give 32.1 to 32.6."""


@pytest.mark.slow
def test_cut_outs_with_cameras_train_as_well_as_with_points(built: Build, trained: Train) -> None:
    result = trained(built("cutouts-with-cameras"), "--steps", "600")
    assert result.report["facts"]["transparent"] == result.report["facts"]["views"]
    assert result.report["plan"]["initial"] == "points"
    assert "Stereo added" in result.output
    assert result.psnr > RIGHT - SPREAD
