"""Proves that wholly transparent photos are left out by name, and opaque ones among cut-outs are named, with given
cameras and without.

Not proven here: what a training makes of an opaque one; that such a photo is not blamed for its light is in
test_disagreement.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker.images.prepare import prepare
from tests.support.posed_sets import NAMES, loaded, model

KINDS = {"clear": (0, 0), "haze": (0, 9), "opaque": (255, 255), "cut out": (0, 255), "half": (120, 130)}


def photo(path: Path, kind: str, seed: int) -> None:
    """A photo whose alpha has two values; of an opaque one there is none."""
    values = np.random.default_rng(seed).integers(0, 255, (48, 64, 4), np.uint8)
    values[:, :32, 3], values[:, 32:, 3] = KINDS[kind]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values if kind != "opaque" else values[..., :3].copy()).save(path)


NOTHING = "it is wholly transparent, so it shows nothing"


@pytest.mark.parametrize(
    ("kinds", "left_out", "said"),
    [
        (["cut out"] * 11 + ["clear"], 1, ()),
        (["cut out"] * 10 + ["half", "haze"], 1, ()),
        (["opaque"] * 12, 0, ()),
        (
            ["opaque"] * 2 + ["cut out"] * 10,
            0,
            ("2 photos are opaque, and the other 10 have transparent parts: ",),
        ),
        (["cut out"] + ["opaque"] * 11, 0, ("1 photo is partly transparent, and the other 11 are opaque: ",)),
    ],
)
@pytest.mark.parametrize("posed", [True, False])
def test_transparency_that_contradicts_the_others(
    kinds: list[str], left_out: int, said: tuple[str, ...], posed: bool, tmp_path: Path
) -> None:
    names = [f"{Path(name).stem}.png" for name in NAMES]
    for seed, (name, kind) in enumerate(zip(names, kinds, strict=True)):
        photo(tmp_path / "images" / name, kind, seed)
    if posed:
        model(tmp_path / "sparse/0")
        scene = loaded(tmp_path)
        used, omitted, warnings = len(scene.views), scene.left_out, scene.warnings
    else:
        prepared = prepare(tmp_path / "images", None, tmp_path / "work")
        used, omitted, warnings = len(prepared.photos), prepared.skipped, prepared.warnings
    assert omitted == ((names[11], NOTHING),) * left_out
    assert used == 12 - left_out
    assert tuple(warning.split(": ")[0] + ": " for warning in warnings) == said


def test_nothing_but_transparent_photos_is_refused(tmp_path: Path) -> None:
    for name in NAMES:
        photo(tmp_path / "images" / f"{Path(name).stem}.png", "clear", 0)
    model(tmp_path / "sparse/0")
    with pytest.raises(ValueError, match="All 12 photos with a camera are wholly transparent"):
        loaded(tmp_path)
