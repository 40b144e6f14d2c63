"""Proves that the page reads the levels of masks, and the names in zips of Windows, as the worker does.

Does not prove that browsers decode the masks as Pillow does.
"""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatmill.schema.files.masks import MASK_BEGINNINGS, MASK_ENDINGS
from splatmill_worker.images.mask_levels import judged
from tests.support.files import unmarked_zip
from tests.support.paths import ROOT
from tests.support.programs import node

PROGRAM = """
import fs from "node:fs";
import { levels } from "./looking/measure.js";
import { onMasks } from "./remarks.js";
import { namesIn } from "./zip.js";
const { pictures, accepted, zip } = JSON.parse(fs.readFileSync(0));
const counts = pictures.map((pixels) => levels(new Uint8ClampedArray(pixels)));
const masks = counts.map((levels, number) => ({ name: `${number}.png`, levels }));
const names = await namesIn(new Blob([fs.readFileSync(zip)]));
console.log(JSON.stringify([onMasks(masks, pictures.map((_, number) => `${number}.jpg`), accepted), names]));
"""


@pytest.fixture
def page(tmp_path: Path) -> Path:
    folder = tmp_path / "page"
    shutil.copytree(ROOT / "server/splatmill_server/web/page/new", folder)
    (folder / "package.json").write_text('{"type": "module"}')
    (folder / "program.js").write_text(PROGRAM)
    return folder


@pytest.mark.parametrize(("low", "high"), [(0, 1), (0, 255), (3, 7), (200, 255), (0, 38)])
def test_masks_and_names_are_read_as_by_the_worker(page: Path, tmp_path: Path, low: int, high: int) -> None:
    masks: dict[str, Path | None] = {}
    pictures = []
    for number in range(3):
        picture = Image.fromarray(np.tile(np.array([low, low, low, high], np.uint8), (4, 1)))
        picture.save(tmp_path / f"{number}.png")
        masks[f"{number}.jpg"] = tmp_path / f"{number}.png"
        pictures.append(list(picture.convert("RGBA").tobytes()))
    names = ["images/ソ表.jpg", "a/b.jpg"]
    unmarked_zip.write(tmp_path / "set.zip", [(name.encode("cp932"), b"x") for name in names])
    accepted = {"mask_endings": MASK_ENDINGS, "mask_beginnings": MASK_BEGINNINGS}
    asked: dict[str, Any] = {"pictures": pictures, "accepted": accepted, "zip": str(tmp_path / "set.zip")}
    command = [*node("qr"), str(page / "program.js")]
    done = subprocess.run(command, input=json.dumps(asked), capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [list(judged(masks, []).warnings), names]
