"""Writes photos of the still life as a camera would leave them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import torch
from PIL import Image

from splatmill_worker.scene import Camera
from splatmill_worker.synthetic.light import Light
from splatmill_worker.synthetic.movers import Movers, changed
from splatmill_worker.synthetic.ray_caster import orbit, picture, still_life


def capture(
    directory: Path,
    count: int = 40,
    width: int = 640,
    height: int = 480,
    seed: int = 0,
    samples: int = 2,
    light: Light | None = None,
    movers: Movers | None = None,
    truth: Path | None = None,
    begin: Callable[[str], None] = lambda name: None,
) -> dict[str, Camera]:
    """Write `count` photos of the still life to `directory`, as JPEGs with EXIF; returns the true camera of each name.

    width, height: in pixels. seed: of the scene and of the cameras. samples: rays per pixel along each axis.
    light: what the camera makes of the scene's colours; None where it keeps them.
    movers: what passes by; None where nothing does.
    truth: folder for a PNG of each photo with movers, white where they changed it; None: none are written.
    begin: called with the name of each photo before it is made, in several threads; what it raises ends all.
    """
    directory.mkdir(parents=True, exist_ok=True)
    if truth is not None and movers is not None:
        truth.mkdir(parents=True, exist_ok=True)
    scene = still_life(seed)
    cameras = {f"still_{k + 1:04d}.jpg": c for k, c in enumerate(orbit(count, width, height, seed))}
    gains = None if light is None else dict(zip(cameras, light.gains(count, seed), strict=True))
    passing = {} if movers is None else dict(zip(cameras, movers.passing(count, seed), strict=True))

    def shoot(name: str) -> None:
        begin(name)
        camera = cameras[name]
        rgb = picture(scene, camera, samples)
        if passing.get(name):
            without = rgb
            rgb = picture(replace(scene, solids=(*scene.solids, *passing[name])), camera, samples)
            if truth is not None:
                Image.fromarray(changed(rgb, without)).save((truth / name).with_suffix(".png"))
        if light is not None and gains is not None:
            rgb = light.falling_on(rgb, gains[name])
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "Splatmill", "Ray caster"
        # 35 mm equivalent over the longer side, which is how SfM reads it back into pixels.
        exif.get_ifd(0x8769)[0xA405] = round(35 * camera.fx / max(width, height))
        Image.fromarray(rgb).save(directory / name, quality=95, exif=exif)

    # One photo per thread: bands are too small for torch's own threads.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(shoot, cameras))
    finally:
        torch.set_num_threads(threads)
    return cameras
