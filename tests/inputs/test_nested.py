"""A data set that lies one folder deeper than expected trains with its own cameras."""

from __future__ import annotations

import pytest

from tests.inputs.conftest import PLAIN_WITH_CAMERAS, Build, Train


@pytest.mark.slow
def test_a_data_set_one_folder_down_trains_with_its_cameras(built: Build, trained: Train) -> None:
    result = trained(built("nested-data-set"))
    assert result.report["facts"]["source"] == "colmap"
    assert result.psnr > PLAIN_WITH_CAMERAS - 0.5
