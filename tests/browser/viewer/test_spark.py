"""Spark (World Labs) reads in a browser what we write: another foreign reader of each format beside splat-transform and
the library of `.spz`.

Does not prove what Spark draws, nor the harmonics, of which only their number is compared.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from playwright.sync_api import Browser, Page, Route

from splatmill_worker.splat.formats import compressed_ply, ply, registry, sog, spz
from tests.support.gaussians import some_gaussians
from tests.support.paths import ROOT
from tests.support.programs import npm_package

INSTALLED = ROOT / "server/web/node_modules"
ADDRESS = "http://spark.test"
PAGE = """<!doctype html><script type="importmap">{"imports": {
  "three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/",
  "spark": "/@sparkjsdev/spark/dist/spark.module.js"}}</script>"""

READ = """async ([text, fileName]) => {
  const { PackedSplats } = await import("spark");
  const fileBytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const splats = new PackedSplats({ fileBytes, fileName });
  await splats.initialized;
  const rows = [];
  splats.forEachSplat((index, center, scales, turn, opacity, color) =>
    rows.push([...center, ...scales, turn.w, turn.x, turn.y, turn.z, opacity, ...color]));
  return [splats.getNumSh(), rows];
}"""

SH_C0 = 0.28209479177387814
WRITERS: dict[str, Any] = {"ply": ply, "compressed.ply": compressed_ply, "sog": sog, "spz": spz}


@pytest.fixture(scope="module")
def page(browser: Browser) -> Iterator[Page]:
    """A page that may import Spark."""
    npm_package("@sparkjsdev/spark")

    def answer(route: Route) -> None:
        name = route.request.url.removeprefix(f"{ADDRESS}/")
        if not name:
            route.fulfill(body=PAGE, content_type="text/html")
        else:
            route.fulfill(path=INSTALLED / name, content_type="text/javascript")

    page = browser.new_page()
    page.route("**/*", answer)
    page.goto(ADDRESS)
    yield page
    page.close()


@pytest.mark.parametrize("suffix", list(WRITERS))
def test_spark_reads_what_we_write(page: Page, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"ours.{suffix}"
    WRITERS[suffix].write(path, some_gaussians(300, 3))
    content = base64.b64encode(path.read_bytes()).decode()
    degree, rows = page.evaluate(READ, [content, path.name])
    read, ours = torch.tensor(rows), registry.read(path).gaussians
    means, turns = ours.means, torch.nn.functional.normalize(ours.quats, dim=1)
    if suffix == "spz":  # Spark keeps the frame of the file, y up and z to the back
        means, turns = means * torch.tensor([1, -1, -1]), turns * torch.tensor([1, 1, -1, -1])
    assert degree == 3
    assert read.shape == (ours.count, 14)
    # Spark holds half floats, 8 bits for colours, opacities and logarithms of scales, and 24 bits for rotations.
    torch.testing.assert_close(read[:, :3], means, rtol=1e-3, atol=1e-3)
    assert float((read[:, 3:6].log() - ours.log_scales).abs().max()) < 0.05
    assert float((read[:, 6:10] * turns).sum(1).abs().min()) > 0.999
    assert float((read[:, 10] - ours.logit_opacities.sigmoid()).abs().max()) < 1.1 / 255
    colors = (0.5 + SH_C0 * ours.sh[:, 0]).clamp(0, 1)
    assert float((read[:, 11:] - colors).abs().max()) < 1.1 / 255
