"""Photos that lie beside smaller copies of themselves are used without these.

Does not prove what counts as a copy; tests/worker/images/test_copies.py does.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from splatmill_worker.images.prepare import prepare
from tests.inputs.conftest import Build


@pytest.mark.slow
def test_resized_copies_are_left_out_and_named(built: Build, tmp_path: Path) -> None:
    found = prepare(built("copies"), None, tmp_path)
    names = [f"still_{k:04d}.jpg" for k in range(1, 31)]
    assert [photo.name for photo in found.photos] == names
    assert dict(found.skipped) == {f"web/{name}": f"it shows the same as {name}" for name in names}
    assert any("30 photos show the same as another one" in warning for warning in found.warnings)
