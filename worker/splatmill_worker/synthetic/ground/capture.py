"""Writes the photos of a flight as a camera would leave them, and the true cameras in a folder beside them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch
from PIL import Image, TiffImagePlugin

from splatmill_worker.colmap import pycolmap, write_model
from splatmill_worker.scene import Camera
from splatmill_worker.synthetic.ground.caster import photograph
from splatmill_worker.synthetic.ground.flight import Flight
from splatmill_worker.synthetic.ground.town import Town

PHOTOS, TRUTH = "photos", "truth"
"""Folders of a capture: the photos, and a COLMAP text model of the true cameras under their names, in metres."""

NOISE = 1.5
"""Standard deviation of the sensor's noise in grey levels of 255, of all channels of a pixel together."""


def capture(
    directory: Path,
    count: int,
    width: int = 640,
    height: int = 480,
    seed: int = 0,
    samples: int = 2,
    flight: Flight | None = None,
    done: Callable[[int], None] = lambda photos: None,
) -> dict[str, Camera]:
    """Write `count` photos to `directory`/photos and their cameras to `directory`/truth; returns the cameras by name.

    width, height: in pixels. seed: of town, flight and noise. samples: rays per pixel along each axis.
    flight: Flight() where it is left out. done: called with the number of finished photos after each.
    Raises FileExistsError where there are photos already, and ValueError for a flight that is lower than the town.
    """
    photos, truth = directory / PHOTOS, directory / TRUTH
    for folder in (photos, truth):
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise FileExistsError(17, "There are files already; choose another folder", str(folder))
    flight = flight or Flight()
    cameras = flight.cameras(count, width, height, seed)
    named = {f"ground_{k + 1:05d}.jpg": camera for k, camera in enumerate(cameras)}
    measured = dict(zip(named, flight.measured(cameras, seed), strict=True))
    town = Town(seed)

    def shoot(number: int, name: str) -> None:
        rgb = photograph(town, named[name], samples)
        random = np.random.default_rng([seed, 25, number])
        noisy = rgb + random.normal(0.0, NOISE, rgb.shape[:2])[..., None]
        picture = Image.fromarray((noisy + 0.5).clip(0, 255).astype(np.uint8))
        picture.save(photos / name, quality=95, exif=_exif(named[name], measured[name]))

    # One photo per thread: what a photo needs is computed in parts that are too small for torch's own threads.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            for number, _ in enumerate(pool.map(shoot, range(count), named)):
                done(number + 1)
    finally:
        torch.set_num_threads(threads)
    write_truth(named, truth)
    return named


def write_truth(named: dict[str, Camera], folder: Path) -> None:
    """Write cameras of one lens, by the names of their photos, to an existing folder: COLMAP's text without points.

    Raises OSError where it cannot be written whole.
    """
    model = pycolmap.Reconstruction()
    first = next(iter(named.values()))
    params = [first.fx, first.fy, first.cx, first.cy]
    lens = pycolmap.Camera(
        model="PINHOLE", width=first.width, height=first.height, params=params, camera_id=1
    )
    model.add_camera_with_trivial_rig(lens)
    for number, (name, camera) in enumerate(named.items(), 1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.viewmat[:3]))
    write_model(model, folder, text=True)


def _exif(camera: Camera, measured: np.ndarray) -> Image.Exif:
    """EXIF with the focal length and the measured latitude, longitude [degrees] and altitude [m]."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Splatmill", "Ground"
    # 35 mm equivalent over the longer side, which is how SfM reads it back into pixels.
    exif.get_ifd(0x8769)[0xA405] = round(35 * camera.fx / max(camera.width, camera.height))
    latitude, longitude, altitude = measured.tolist()
    exif.get_ifd(0x8825).update(
        {
            1: "N" if latitude >= 0 else "S",
            2: _sexagesimal(abs(latitude)),
            3: "E" if longitude >= 0 else "W",
            4: _sexagesimal(abs(longitude)),
            5: b"\x00" if altitude >= 0 else b"\x01",
            6: _rational(abs(altitude), 1000),
        }
    )
    return exif


def _sexagesimal(degrees: float) -> tuple[TiffImagePlugin.IFDRational, ...]:
    """Degrees, minutes and seconds, to a ten-thousandth of a second: three millimetres."""
    whole, minutes = divmod(degrees * 60.0, 60.0)
    whole_minutes, seconds = divmod(minutes * 60.0, 60.0)
    return _rational(whole, 1), _rational(whole_minutes, 1), _rational(seconds, 10_000)


def _rational(value: float, parts: int) -> TiffImagePlugin.IFDRational:
    return TiffImagePlugin.IFDRational(Fraction(round(value * parts), parts))
