"""Proves which photos count as copies of another one, and that the largest is kept: resized, compressed again,
brightened, turned, cropped and straightened ones are found; neighbouring frames, stereo pairs and what changes before a
still background are not.

Not proven here: that a copy is found after any other change, such as a filter that draws outlines.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image, ImageDraw, ImageEnhance

from splatmill_worker.images.copies import (
    ALIKE,
    ALIKE_CROPPED,
    EXACT,
    GRID,
    NEAREST,
    ROWS,
    SmallPicture,
    _nearest,
    copies,
    small_grey,
)
from splatmill_worker.images.flow import sampled
from splatmill_worker.images.prepare import prepare
from splatmill_worker.synthetic import orbit, photograph, still_life

Change = Callable[[Image.Image], Image.Image]


@cache
def photos() -> tuple[Image.Image, ...]:
    """Photos of the still life from sides that are 60 degrees apart."""
    life = still_life(0)
    return tuple(Image.fromarray(photograph(life, camera, samples=2)[0]) for camera in orbit(6, 240, 180))


def small(photo: Image.Image, name: str) -> SmallPicture:
    return SmallPicture(name, *photo.size, small_grey(photo))


def compressed(quality: int) -> Change:
    def change(photo: Image.Image) -> Image.Image:
        buffer = io.BytesIO()
        photo.save(buffer, "JPEG", quality=quality)
        return Image.open(buffer).convert("RGB")

    return change


def straightened(photo: Image.Image) -> Image.Image:
    """As a tool that takes out the distortion of a lens leaves it."""
    values = np.asarray(photo, np.float32)
    height, width = values.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = (x - width / 2) / (width / 2), (y - height / 2) / (width / 2)
    scale = 0.97 * (1.0 + 0.05 * (x * x + y * y))
    row, column = y * scale * (width / 2) + height / 2, x * scale * (width / 2) + width / 2
    planes = [sampled(np.ascontiguousarray(values[..., c]), row, column) for c in range(3)]
    return Image.fromarray(np.stack(planes, axis=-1).astype(np.uint8))


def exposed(stops: float) -> Change:
    """As the same camera takes it with a longer exposure, clipped at white."""

    def change(photo: Image.Image) -> Image.Image:
        srgb = np.asarray(photo, np.float64) / 255.0
        light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4) * 2.0**stops
        light = np.clip(light, 0.0, 1.0)
        srgb = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
        return Image.fromarray(np.round(srgb * 255.0).astype(np.uint8))

    return change


CHANGES: dict[str, Change] = {
    "half the size": lambda photo: photo.resize((120, 90), Image.Resampling.LANCZOS),
    "a thumbnail": lambda photo: photo.resize((64, 48), Image.Resampling.BICUBIC),
    "strongly compressed": compressed(15),
    "brighter": lambda photo: ImageEnhance.Brightness(photo).enhance(1.2),
    "darker": lambda photo: ImageEnhance.Brightness(photo).enhance(0.6),
    "twice as bright, clipped": lambda photo: ImageEnhance.Brightness(photo).enhance(2.0),
    "exposed two stops longer": exposed(2.0),
    "exposed three stops shorter": exposed(-3.0),
    "more contrast": lambda photo: ImageEnhance.Contrast(photo).enhance(1.4),
    "without colours": lambda photo: photo.convert("L").convert("RGB"),
    "a quarter turn": lambda photo: photo.transpose(Image.Transpose.ROTATE_90),
    "upside down and smaller": lambda photo: photo.resize((120, 90)).transpose(Image.Transpose.ROTATE_180),
    "cropped": lambda photo: photo.crop((10, 8, 230, 172)),
    "cropped to a square": lambda photo: photo.crop((30, 0, 210, 180)),
    "straightened": straightened,
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_a_copy_is_found_and_the_original_is_kept(change: Change) -> None:
    pictures = [small(change(photo), f"corrected/{k}.jpg") for k, photo in enumerate(photos())]
    pictures += [small(photo, f"{k}.jpg") for k, photo in enumerate(photos())]
    assert copies(pictures) == {k: k + 6 for k in range(6)}


@pytest.mark.parametrize("stops", [(2.0, 0.0, -3.0), (-3.0, 2.0, 0.0), (1.5, 0.0)])
def test_of_an_exposure_series_the_photo_with_the_fewest_clipped_pixels_is_kept(
    stops: tuple[float, ...],
) -> None:
    """In whatever order the exposures were taken."""
    series = [small(exposed(stop)(photos()[0]), f"{k}.jpg") for k, stop in enumerate(stops)]
    best = stops.index(0.0)
    assert copies(series) == {k: best for k in range(len(stops)) if k != best}


def test_photos_from_other_sides_are_no_copies() -> None:
    assert copies([small(photo, f"{k}.jpg") for k, photo in enumerate(photos())]) == {}


@pytest.mark.parametrize("step", [3, 6, 12])
def test_frames_of_a_slow_video_are_no_copies(step: int) -> None:
    """They move by 0.6, 1.2 and 2.5 % of the picture."""
    large = photos()[0].resize((720, 540), Image.Resampling.BICUBIC)
    frames = [large.crop((k * step, 20, k * step + 480, 380)) for k in range(10)]
    assert copies([small(frame, f"{k}.jpg") for k, frame in enumerate(frames)]) == {}


def test_what_turns_before_a_still_background_is_no_copy() -> None:
    frames = []
    for k in range(6):
        frame = photos()[0].copy()
        frame.paste(photos()[k].crop((90, 60, 150, 120)), (90, 60))
        frames.append(small(frame, f"{k}.jpg"))
    assert copies(frames) == {}


@pytest.mark.parametrize("level", [0, 128, 255])
def test_plain_photos_are_no_copies(level: int) -> None:
    frames = [Image.new("RGB", (240, 180), (level,) * 3) for _ in range(4)]
    assert copies([small(frame, f"{k}.jpg") for k, frame in enumerate(frames)]) == {}
    for k, frame in enumerate(frames):
        ImageDraw.Draw(frame).ellipse((40 + 20 * k, 40, 80 + 20 * k, 80), fill=(90, 90, 90))
    assert copies([small(frame, f"{k}.jpg") for k, frame in enumerate(frames)]) == {}


def test_a_stereo_rig_with_one_name_per_pair_has_no_copies() -> None:
    frames = [small(photo.crop((x, 0, x + 200, 180)), f"{side}/{k}.jpg")
              for k, photo in enumerate(photos()) for side, x in (("left", 4), ("right", 0))]  # fmt: skip
    assert copies(frames) == {}


def test_copies_are_left_out_with_a_word_and_their_mask_is_kept(tmp_path: Path) -> None:
    images = tmp_path / "images"
    (images / "web").mkdir(parents=True)
    for k, photo in enumerate(photos()):
        photo.save(images / f"{k}.jpg", quality=95)
        photo.resize((120, 90)).save(images / "web" / f"{k}.png")
    mask = Image.new("L", (120, 90), 255)
    ImageDraw.Draw(mask).rectangle((0, 0, 30, 30), fill=0)
    (tmp_path / "masks" / "web").mkdir(parents=True)
    mask.save(tmp_path / "masks" / "web" / "2.png")
    result = prepare(images, tmp_path / "masks", tmp_path / "work")
    assert [photo.name for photo in result.photos] == [f"{k}.jpg" for k in range(6)]
    assert dict(result.skipped) == {f"web/{k}.png": f"it shows the same as {k}.jpg" for k in range(6)}
    assert [photo.mask for photo in result.photos if photo.mask is not None] == [
        tmp_path / "masks" / "web" / "2.png"
    ]
    assert "6 photos show the same as another one" in result.warnings[-1]


def grids(rng: np.random.Generator, count: int) -> npt.NDArray[np.float32]:
    """Random pictures of which many are nearly or exactly alike, some of them turned."""
    base = rng.normal(size=(max(1, count // 4), GRID, GRID))
    chosen = base[rng.integers(len(base), size=count)]
    noise = rng.choice([0.0, 0.2, 0.6], size=(count, 1, 1)) * rng.normal(size=chosen.shape)
    turned = [
        np.rot90(each, turns) for each, turns in zip(chosen + noise, rng.integers(4, size=count), strict=True)
    ]
    result = np.stack(turned)
    result -= result.mean(axis=(1, 2), keepdims=True)
    result *= EXACT / np.linalg.norm(result, axis=(1, 2), keepdims=True)
    rounded: npt.NDArray[np.float32] = np.rint(result).astype(np.float32)
    return rounded


def nearest_of_all_pairs(
    pictures: npt.NDArray[np.float32], sizes: npt.NDArray[np.int64], stems: npt.NDArray[np.int64]
) -> dict[int, list[tuple[int, int]]]:
    """In whole numbers, with a sort in place of a search for the largest."""
    count = len(pictures)
    flat = pictures.reshape(count, -1).astype(np.int64)
    cropped = (sizes[:, None] != sizes) | (stems[:, None] == stems)
    ranked: dict[int, list[tuple[int, int, int]]] = {}
    for turns in range(4):
        similar = np.rot90(pictures, turns, axes=(1, 2)).reshape(count, -1).astype(np.int64) @ flat.T
        least = np.where(cropped & (turns == 0), ALIKE_CROPPED, ALIKE) * EXACT**2
        for first in range(count):
            alike = [
                (-int(similar[first, second]), second, turns)
                for second in range(count)
                if first != second and similar[first, second] >= least[first, second]
            ]
            if alike:
                ranked.setdefault(first, []).extend(sorted(alike)[:NEAREST])
    return {first: [(second, turns) for _, second, turns in sorted(each)] for first, each in ranked.items()}


@pytest.mark.parametrize(("count", "kinds"), [(2, 1), (3, 1), (150, 1), (150, 3), (ROWS + 1, 1)], ids=str)
def test_likely_copies_in_blocks_are_those_of_all_pairs(count: int, kinds: int) -> None:
    rng = np.random.default_rng(count + kinds)
    pictures, sizes = grids(rng, count), rng.integers(kinds, size=count)
    stems = np.arange(count) if kinds == 1 else rng.integers(count // 2, size=count)
    expected = nearest_of_all_pairs(pictures, sizes, stems)
    assert _nearest(pictures, sizes, stems) == expected
    assert count < 100 or len(expected) > count // 2
