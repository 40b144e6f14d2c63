"""The model files of other programs are read as the model that they were made from, drawn as they say, and upright.

Does not prove other formats than `.ply`; tests/worker/splat/formats does.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatmill.schema import CameraSpec, OrbitRequest
from splatmill_worker.render_service.encoding import camera_of, render_frame
from splatmill_worker.render_service.local import loaded
from splatmill_worker.splat.formats import ply, registry
from splatmill_worker.splat.gaussians import SH_C0, Gaussians
from splatmill_worker.splat.orbit import UP, orbit_cameras
from splatmill_worker.splat.render import render
from tests.inputs.conftest import INPUTS
from tests.support.gaussians import differences, some_gaussians
from tests.support.paths import DATA

pytestmark = pytest.mark.slow

GUITAR = DATA / "splats/guitar.compressed.ply"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with base.ply and the variants that the script of the inputs makes of it."""
    if not INPUTS.is_dir():
        pytest.skip("the shared inputs are not on this machine")
    folder = tmp_path_factory.mktemp("models")
    scene = some_gaussians(300, 3)
    # Small ones, which the filter of Mip-Splatting changes, of colours that 8 bits hold without clipping.
    ply.write(
        folder / "base.ply", replace(scene, log_scales=scene.log_scales - 3, sh=scene.sh.clamp(-1.7, 1.7))
    )
    script = INPUTS / "model-files/build.py"
    subprocess.run([sys.executable, script, folder / "base.ply", folder], check=True, timeout=60)
    return folder


def base_colors(scene: Gaussians) -> Gaussians:
    return replace(scene, sh=scene.sh[:, :1])


def flat(scene: Gaussians) -> Gaussians:
    thin = scene.log_scales[:, :2].amin(dim=1, keepdim=True) + np.log(1e-3)
    return replace(scene, log_scales=torch.cat([scene.log_scales[:, :2], thin], dim=1))


@pytest.mark.parametrize(
    ("name", "expected", "said"),
    [
        ("rgb.ply", base_colors, "red, green and blue"),
        ("2dgs.ply", flat, "no scale_2"),
        ("sh4.ply", None, "degree 4 are read to degree 3"),
        ("faces.ply", None, None),
        ("mip.ply", None, None),
    ],
)
def test_variants_hold_the_model_and_say_what_is_dropped(
    files: Path, name: str, expected: Callable[[Gaussians], Gaussians] | None, said: str | None
) -> None:
    base, contents = ply.read(files / "base.ply").gaussians, ply.read(files / name)
    differing = differences(contents.gaussians, expected(base) if expected else base)
    assert max(differing.values()) < (1 / 255 / SH_C0 + 1e-5 if name == "rgb.ply" else 1e-5)
    assert (said or "") in " ".join(contents.notes)
    assert bool(said) == bool(contents.notes)


def test_a_model_of_mip_splatting_is_drawn_antialiased(files: Path) -> None:
    camera = camera_of(CameraSpec.looking_at((6, 0, 0), (0, 0, 0), width=96, height=64))
    scene = ply.read(files / "base.ply").gaussians
    right, wrong = (
        render(scene, camera, background=(0, 0, 0), antialias=antialias).color.clamp(0, 1)
        for antialias in (True, False)
    )
    with loaded(files / "mip.ply") as model:
        picture = torch.from_numpy(render_frame(model, camera, "black")) / 255
    assert float((picture - right).abs().max()) < 0.01
    assert float((wrong - right).abs().max()) > 0.1


@pytest.mark.skipif(not GUITAR.is_file(), reason="the shared data sets are not on this machine")
def test_the_orbit_of_a_guitar_shows_it_upright() -> None:
    scene = registry.read(GUITAR).gaussians
    # The first camera of a circle and the opposite one see the front and the back.
    for camera in list(orbit_cameras(None, scene, OrbitRequest(seconds=1), UP))[::12]:
        points = scene.means.double().numpy() @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        across, down = (points[:, :2] / points[:, 2:]).T
        top, bottom = np.quantile(down, [0.01, 0.99])
        assert bottom - top > 2 * np.ptp(np.quantile(across, [0.01, 0.99]))
        neck, body = across[down < top + (bottom - top) / 3], across[down > bottom - (bottom - top) / 3]
        assert neck.std() < 0.6 * body.std()
