"""Proves what is found to stand still in photos, and masked: logos, watermarks, time codes, bars and dashboards, opaque
and transparent, at several places; and that a scene alone, few photos, a slow camera, a level circle and things that
turn before a plain background have nothing masked.

Not proven here: that digits which change are masked beside those that stay.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw

from splatmill_worker.images.overlays.overlay import MIN_PHOTOS
from splatmill_worker.images.overlays.overlays import Candidate, hidden_in
from splatmill_worker.images.prepare import Prepared, prepare
from splatmill_worker.synthetic import look_at, orbit, photograph, still_life

WIDTH, HEIGHT = 320, 240
Draw = Callable[[Image.Image, int], Image.Image]


@cache
def photos() -> tuple[Image.Image, ...]:
    life = still_life(0)
    return tuple(
        Image.fromarray(photograph(life, camera, samples=1)[0]) for camera in orbit(16, WIDTH, HEIGHT)
    )


def drawn(draw: Callable[[ImageDraw.ImageDraw, int], None], alpha: float = 1.0) -> Draw:
    def change(photo: Image.Image, number: int) -> Image.Image:
        over = photo.copy()
        draw(ImageDraw.Draw(over), number)
        return Image.blend(photo, over, alpha)

    return change


def letters(pen: ImageDraw.ImageDraw, left: int, top: int, seed: int = 0, size: int = 5) -> None:
    """A text of eight letters, which are patterns of squares."""
    pattern = np.random.default_rng(seed).integers(0, 2, (3, 24))
    for row, column in np.argwhere(pattern):
        x, y = left + column * size, top + row * size
        pen.rectangle((x, y, x + size - 1, y + size - 1), fill=(250, 250, 250))


def two(pen: ImageDraw.ImageDraw, number: int) -> None:
    letters(pen, 10, 8)
    letters(pen, 185, 215, 1)


def clock(pen: ImageDraw.ImageDraw, number: int) -> None:
    """A date that stays, and a time that changes, on black."""
    pen.rectangle((10, 210, 250, 232), fill=(0, 0, 0))
    letters(pen, 14, 214)
    letters(pen, 140, 214, seed=number + 1, size=4)


def bars(pen: ImageDraw.ImageDraw, number: int) -> None:
    pen.rectangle((0, 0, WIDTH, 23), fill=(0, 0, 0))
    pen.rectangle((0, HEIGHT - 24, WIDTH, HEIGHT), fill=(0, 0, 0))


def dashboard(pen: ImageDraw.ImageDraw, number: int) -> None:
    pen.polygon(((0, 180), (120, 180), (150, 240), (0, 240)), fill=(20 + 3 * number,) * 3)


# What is drawn, at which places (x, y) it is masked, and which share of the photo at most.
MASKED: dict[str, tuple[Draw, tuple[tuple[int, int], ...], float]] = {
    "a logo": (drawn(lambda pen, k: letters(pen, 10, 215)), ((60, 222),), 0.08),
    "a half transparent one": (drawn(lambda pen, k: letters(pen, 180, 8), 0.5), ((240, 15),), 0.08),
    "two": (
        drawn(two),
        ((60, 15), (240, 222)),
        0.15,
    ),
    "a grey disc": (
        drawn(lambda pen, k: pen.ellipse((250, 10, 300, 60), fill=(110, 110, 110))),
        ((275, 35),),
        0.08,
    ),
    "a clock": (drawn(clock), ((60, 222),), 0.15),
    "bars": (drawn(bars), ((160, 10), (160, 230), (10, 10)), 0.25),
    "a dashboard": (drawn(dashboard), ((60, 220), (20, 230)), 0.2),
}


def prepared(tmp_path: Path, change: Draw, count: int = 16) -> Prepared:
    folder = tmp_path / "images"
    folder.mkdir()
    for k, photo in enumerate(photos()[:count]):
        change(photo, k).save(folder / f"{k:02d}.jpg", quality=92)
    return prepare(folder, None, tmp_path / "work")


@pytest.mark.parametrize(("draw", "places", "most"), MASKED.values(), ids=MASKED.keys())
def test_what_never_moves_is_masked(
    tmp_path: Path, draw: Draw, places: tuple[tuple[int, int], ...], most: float
) -> None:
    result = prepared(tmp_path, draw)
    masks = {photo.mask for photo in result.photos}
    assert len(masks) == 1
    (path,) = masks
    assert path is not None
    mask = np.asarray(Image.open(path).resize((WIDTH, HEIGHT), Image.Resampling.NEAREST))
    assert [int(mask[y, x]) for x, y in places] == [0] * len(places)
    assert mask[HEIGHT // 2, WIDTH // 2] == 255
    assert 0.0 < (mask == 0).mean() <= most
    assert "never changes in 16 photos of 320 x 240 pixels" in result.warnings[-1]
    assert [overlay.photos for overlay in result.overlays] == [tuple(f"{k:02d}.jpg" for k in range(16))]


def turning(level: int) -> Draw:
    """A thing of changing outline before a plain background."""

    def change(photo: Image.Image, number: int) -> Image.Image:
        inside = Image.new("L", photo.size, 0)
        j = np.random.default_rng(number).uniform(-15, 15, 4)
        ImageDraw.Draw(inside).ellipse((70 + j[0], 30 + j[1], 250 + j[2], 220 + j[3]), fill=255)
        return Image.composite(photo, Image.new("RGB", photo.size, (level,) * 3), inside)

    return change


def slow(photo: Image.Image, number: int) -> Image.Image:
    large = photos()[0].resize((2 * WIDTH, 2 * HEIGHT), Image.Resampling.BICUBIC)
    return large.crop((4 * number, 100, 4 * number + WIDTH, 100 + HEIGHT))


NOTHING: dict[str, Draw] = {
    "a scene": lambda photo, number: photo,
    "a white background": turning(255),
    "a black background": turning(0),
    "a grey background": turning(128),
    "a slow camera": slow,
}


@pytest.mark.parametrize("change", NOTHING.values(), ids=NOTHING.keys())
def test_a_scene_alone_has_nothing_masked(tmp_path: Path, change: Draw) -> None:
    result = prepared(tmp_path, change)
    assert [photo.mask for photo in result.photos] == [None] * 16
    assert result.overlays == ()
    assert result.warnings == ()


def test_a_rim_and_a_horizon_that_stay_on_a_level_circle_are_not_masked(tmp_path: Path) -> None:
    life = still_life(0)
    folder = tmp_path / "images"
    folder.mkdir()
    for k in range(24):
        turn = 0.75 * 2.0 * np.pi * k / 24
        eye = 3.7 * np.array([np.cos(turn) * np.cos(0.5), np.sin(turn) * np.cos(0.5), np.sin(0.5)])
        camera = look_at(eye, np.array([0.0, 0.0, 0.25]), WIDTH, HEIGHT, 262.5)
        Image.fromarray(photograph(life, camera, samples=1)[0]).save(folder / f"{k:02d}.png")
    result = prepare(folder, None, tmp_path / "work")
    assert result.overlays == ()
    assert [photo.mask for photo in result.photos] == [None] * 24


def test_a_part_that_is_transparent_in_all_photos_is_no_overlay() -> None:
    """As the sky of renderings, whose cameras are known. A logo in the opaque part is found all the same."""
    alpha = Image.new("L", (WIDTH, HEIGHT), 255)
    alpha.paste(0, (0, 0, WIDTH, HEIGHT // 4))
    candidates = [Candidate(f"{k:02d}.png", WIDTH, HEIGHT, "") for k in range(16)]

    def hidden(change: Draw) -> list[np.ndarray | None]:
        cut = [change(photo, k) for k, photo in enumerate(photos()[:16])]
        for photo in cut:
            photo.putalpha(alpha)
        return list(hidden_in(candidates, lambda index, size: cut[index]).regions)

    assert hidden(lambda photo, k: photo.copy()) == [None] * 16
    (region, *_) = hidden(drawn(lambda pen, k: letters(pen, 10, 215)))
    assert region is not None
    assert region[-9, 30]  # at 160 x 120
    assert not region[:30].any()


def test_the_same_is_so_where_cameras_are_recovered(tmp_path: Path) -> None:
    """The small pictures by which photos are compared have grey in place of what is transparent."""
    alpha = Image.new("L", (WIDTH, HEIGHT), 255)
    alpha.paste(0, (0, 0, WIDTH, HEIGHT // 4))
    folder = tmp_path / "images"
    folder.mkdir()
    for k, photo in enumerate(photos()[:16]):
        cut = photo.copy()
        cut.putalpha(alpha)
        cut.save(folder / f"{k:02d}.png")
    result = prepare(folder, None, tmp_path / "work")
    assert result.overlays == ()
    assert [photo.mask for photo in result.photos] == [None] * 16


def test_few_photos_have_nothing_masked(tmp_path: Path) -> None:
    assert prepared(tmp_path, MASKED["a logo"][0], MIN_PHOTOS - 1).overlays == ()


def test_a_still_background_with_detail_is_named_and_not_masked(tmp_path: Path) -> None:
    def change(photo: Image.Image, number: int) -> Image.Image:
        frame = photos()[0].copy()
        frame.paste(photo.crop((110, 70, 210, 170)), (110, 70))
        return frame

    result = prepared(tmp_path, change)
    assert [photo.mask for photo in result.photos] == [None] * 16
    assert "Either the camera stood still, as before a turntable, or it hardly moved" in result.warnings[-1]


def test_the_masks_of_photos_hide_both(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    own = Image.new("L", (WIDTH, HEIGHT), 255)
    ImageDraw.Draw(own).rectangle((200, 0, 320, 60), fill=0)
    own.save(tmp_path / "masks" / "03.png")
    folder = tmp_path / "images"
    folder.mkdir()
    for k, photo in enumerate(photos()):
        MASKED["a logo"][0](photo, k).save(folder / f"{k:02d}.jpg", quality=92)
    result = prepare(folder, tmp_path / "masks", tmp_path / "work")
    path = result.photos[3].mask
    assert path is not None
    assert path != result.photos[4].mask
    mask = np.asarray(Image.open(path))
    assert (mask[222, 60], mask[30, 260], mask[120, 160]) == (0, 0, 255)


def test_round_pictures_are_found_by_folder_and_what_is_still_within_them_too() -> None:
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:240, :320]

    def taken(radius: float | None) -> Image.Image:
        pixels = rng.integers(60, 250, (240, 320, 3), np.uint8)
        if radius is not None:
            pixels[np.hypot(columns - 160, rows - 120) > radius] = 0
        return Image.fromarray(pixels)

    radii = {"a": 118.0, "b": None, "c": 100.0}
    candidates = [
        Candidate(f"{folder}/{number}", 320, 240, folder) for folder in radii for number in range(5)
    ]
    pictures = [taken(radii[each.source]) for each in candidates]
    hidden = hidden_in(candidates, lambda index, size: pictures[index])
    for each, region, circle in zip(candidates, hidden.regions, hidden.circles, strict=True):
        radius = radii[each.source]
        assert (radius is None) == (circle is None) == (region is None)
        if radius is not None and circle is not None and region is not None:
            assert circle.radius * 320 == pytest.approx(radius, abs=2)
            assert region.mean() == pytest.approx(1 - np.pi * (0.98 * radius) ** 2 / (320 * 240), abs=0.02)
    assert [len(each.photos) for each in hidden.shown] == [5, 5]
    assert all("round a circle, is dark in 5 photos of 320 x 240" in said for said in hidden.warnings)


def test_a_ball_that_was_cut_out_is_no_round_picture() -> None:
    rows, columns = np.mgrid[:240, :320]
    inside = np.hypot(columns - 160, rows - 120) < 110
    rng = np.random.default_rng(0)
    pictures = []
    for _ in range(5):
        levels = np.where(inside[..., None], rng.integers(60, 250, (240, 320, 3)), 0)
        pixels = np.concatenate([levels, np.where(inside, 255, 0)[..., None]], axis=2)
        pictures.append(Image.fromarray(pixels.astype(np.uint8)))
    candidates = [Candidate(f"{number}.png", 320, 240, ".") for number in range(5)]
    hidden = hidden_in(candidates, lambda index, size: pictures[index])
    assert hidden.circles == hidden.regions == (None,) * 5
    opaque = hidden_in(candidates, lambda index, size: pictures[index].convert("RGB"))
    assert None not in opaque.circles
