"""Makes the documentation's pictures of what photos do to a model: real trainings on photos of the built-in still life.

    make pictures

It takes some minutes. The pictures are `docs/pictures/photographing.jpg` and `docs/pictures/disagreeing.jpg`.
"""

import json
import math
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from splatmill.schema import TrainOptions
from splatmill_worker import pipeline
from splatmill_worker.scene import Camera, View
from splatmill_worker.sfm.posed.written import transforms_of
from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.picture import as_image
from splatmill_worker.splat.render import render
from splatmill_worker.splat.report import disagreeing
from splatmill_worker.synthetic import Movers, capture, look_at, orbit, photograph, still_life

OUT = Path(__file__).parent / "pictures"
WIDTH, HEIGHT = 640, 480
SHOWN = 400
"""Pixels of the width of each picture in a row."""

BUDGET, SIDE = "20s", 480
"""Of each training: its seconds, and the longest side of the photos in pixels."""

PHOTOS = 40


def main() -> int:
    """Train four times, and write both pictures."""
    around = orbit(PHOTOS, WIDTH, HEIGHT)
    third = [camera for camera in orbit(3 * PHOTOS, WIDTH, HEIGHT) if abs(_azimuth(camera)) < math.pi / 3]
    beside = look_at(np.array([-1.5, 2.7, 1.9]), np.array([0.0, 0.0, 0.25]), WIDTH, HEIGHT, around[0].fx)
    sets = {
        f"{PHOTOS} photos, all around": around,
        "8 photos, all around": orbit(8, WIDTH, HEIGHT),
        f"{len(third)} photos, from one side": third,
    }
    with tempfile.TemporaryDirectory() as folder:
        places = [Path(folder) / str(number) for number in range(len(sets))]
        shown = [
            (title, _view(_trained(cameras, place).out, beside))
            for (title, cameras), place in zip(sets.items(), places, strict=True)
        ]
        _row(OUT / "photographing.jpg", shown)
        passed_by = _passed_by(Path(folder) / "passed-by")
    _row(OUT / "disagreeing.jpg", passed_by)
    return 0


def _azimuth(camera: Camera) -> float:
    """Where around the table a camera stands, in radians; 0 is on the x axis."""
    return math.atan2(camera.center[1], camera.center[0])


def _trained(cameras: Sequence[Camera], place: Path) -> pipeline.Outcome:
    """A model of the still life from photos that `cameras` take."""
    images, scene = place / "images", still_life()
    images.mkdir(parents=True)
    views = [
        View(f"{number:03d}.png", camera, images / f"{number:03d}.png")
        for number, camera in enumerate(cameras)
    ]
    for view in views:
        Image.fromarray(photograph(scene, view.camera)[0]).save(view.image)
    (place / "poses").mkdir()
    (place / "poses" / "transforms.json").write_text(json.dumps(transforms_of(views, frozenset())))
    return _run(place)


def _passed_by(place: Path) -> list[tuple[str, Image.Image]]:
    """The photos of a training that disagree most, marked; things stand in the way in some of its photos."""
    capture(place / "images", PHOTOS, WIDTH, HEIGHT, movers=Movers())
    trained = _run(place).trained
    assert trained is not None
    return [(photo.caption, as_image(photo.picture)) for photo in disagreeing.marked(trained)[:3]]


def _run(place: Path) -> pipeline.Outcome:
    options = TrainOptions.model_validate({"time_budget": BUDGET, "image_size": SIDE})
    return pipeline.run(place, place / "work", options, lambda _: None, lambda: False)


def _view(out: Path, camera: Camera) -> Image.Image:
    return as_image(render(ply.read(out / "model.ply").gaussians, camera).color)


def _row(path: Path, pictures: Sequence[tuple[str, Image.Image]]) -> None:
    """Write pictures side by side, each under its title."""
    height, line, gap = SHOWN * HEIGHT // WIDTH, 24, 6
    whole = Image.new("RGB", (len(pictures) * (SHOWN + gap) - gap, line + height), "white")
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(15)
    for number, (title, picture) in enumerate(pictures):
        left = number * (SHOWN + gap)
        draw.text((left + 2, 3), title, "black", font)
        whole.paste(picture.resize((SHOWN, height), Image.Resampling.LANCZOS), (left, line))
    whole.save(path, quality=85)
    print(path)


if __name__ == "__main__":
    sys.exit(main())
