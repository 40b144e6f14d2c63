"""Photos that lie beside smaller copies of themselves train as the photos alone do, so that no copy of a held-out photo
is trained on."""

from __future__ import annotations

import pytest

from tests.inputs.conftest import PLAIN_WITHOUT_CAMERAS, Build, Train


@pytest.mark.slow
def test_resized_copies_are_left_out_and_named(built: Build, trained: Train) -> None:
    result = trained(built("copies"))
    left_out = {row["photo"]: row["why"] for row in result.report["left_out"] if "photo" in row}
    assert left_out == {
        f"web/still_{k:04d}.jpg": f"it shows the same as still_{k:04d}.jpg" for k in range(1, 31)
    }
    assert any("30 photos show the same as another one" in warning for warning in result.report["warnings"])
    assert abs(result.psnr - PLAIN_WITHOUT_CAMERAS) < 0.3
