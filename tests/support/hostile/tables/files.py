"""Hostile pictures, archives and videos, as the worker finds them among the photos of a capture."""

from __future__ import annotations

import zipfile
from collections.abc import Callable

import numpy as np
from PIL import Image

from tests.support.hostile import archives, pictures, videos
from tests.support.hostile.archives import packed
from tests.support.hostile.bench import Answer, Bench
from tests.support.hostile.entry import Hostile
from tests.support.hostile.pictures import encoded, noise, photo

LEFT_OUT = "left out"

Made = Callable[[], bytes]
"""Makes the file when it is given: those that take long are not made by processes that only collect the tests."""


def _picture(name: str, what: str, data: bytes | Made, kind: str, said: str = "") -> Hostile:
    return Hostile("Pictures", what, _prepared(f"images/{name}", data), kind, said)


def _mask_of_its_shape(bench: Bench) -> Answer:
    """A mask of 675 megapixels of the shape of a photo."""
    photos = {"images/a.jpg": encoded(noise(270, 250), "JPEG")}
    return bench.prepared("masks/a.png", pictures.bomb(), photos)


def _mask_of_another_shape(bench: Bench) -> Answer:
    return bench.prepared("masks/good.png", encoded(Image.new("L", (64, 64)), "PNG"))


def _zip(what: str, data: bytes | Made, kind: str, said: str = "") -> Hostile:
    return Hostile("Archives", what, _prepared("images/set.zip", data), kind, said)


def _video(name: str, what: str, data: bytes | Made, kind: str, said: str = "") -> Hostile:
    return Hostile("Videos", what, _prepared(f"images/{name}", data), kind, said)


def _prepared(name: str, data: bytes | Made) -> Callable[[Bench], Answer]:
    return lambda bench: bench.prepared(name, data if isinstance(data, bytes) else data())


def _large_video(bench: Bench) -> Answer:
    return bench.prepared("images/a.avi", videos.larger_than_8k())


_GREY16 = Image.fromarray(np.asarray(noise().convert("L"), np.uint16) * 257)

FILES = (
    _picture("a.png", "675 megapixels in 117 kB", pictures.bomb, LEFT_OUT, "27000 x 25000 pixels"),
    Hostile(
        "Pictures",
        "a mask of 675 megapixels in 117 kB",
        _mask_of_its_shape,
        "the job fails: `image_too_large`",
        "masks/a.png",
    ),
    Hostile(
        "Pictures",
        "a mask of another shape than its photo",
        _mask_of_another_shape,
        "not used, with a note",
        "shape differs",
    ),
    _picture(
        "a.tif",
        "a TIFF of 65,000 x 65,000 pixels in 110 bytes",
        pictures.huge_tiff(),
        LEFT_OUT,
        "65000 x 65000",
    ),
    _picture("a.jpg", "cut off", photo()[:-600], LEFT_OUT, "does not decode completely"),
    _picture("a.jpg", "empty", b"", LEFT_OUT, "empty"),
    _picture("a.jpg", "EPS called `.jpg`", pictures.EPS, LEFT_OUT, "not an image"),
    _picture("a.png", "SVG called `.png`", pictures.SVG, LEFT_OUT, "HTML or XML"),
    _picture("a.jpg", "GIF called `.jpg`", encoded(noise(), "GIF"), LEFT_OUT, "a GIF picture"),
    _picture("a.jpg", "a JPEG that is a zip as well", photo() + packed({"../a": b"x"}), "used", "1 photo"),
    _picture("a.png", "1 x 1", encoded(Image.new("RGB", (1, 1)), "PNG"), LEFT_OUT, "too small"),
    _picture("a.png", "1 x 100,000", encoded(Image.new("L", (1, 100_000)), "PNG"), LEFT_OUT, "too small"),
    _picture("a.png", "one channel of 16 bits", encoded(_GREY16, "PNG"), LEFT_OUT, "depth maps"),
    _picture("a.jpg", "CMYK", encoded(noise().convert("CMYK"), "JPEG"), "used", "1 photo"),
    _picture(
        "a.webp",
        "an animation",
        encoded(noise(), "WEBP", save_all=True, append_images=[noise(seed=1)]),
        "used, with a note",
        "first one is used",
    ),
    _picture(
        "a.jpg",
        "a colour profile of rubbish",
        encoded(noise(), "JPEG", icc_profile=b"rubbish" * 1000),
        "used",
        "1 photo",
    ),
    _picture(
        "a.jpg",
        "EXIF of loops, wrong types and 4 GB texts",
        pictures.with_exif(pictures.turned_with_rubbish()),
        "used",
        "1 photo",
    ),
    _picture("a.png", "a text that unpacks to 64 MB", pictures.text_bomb, LEFT_OUT, "header"),
    _picture("a.png", "a wrong checksum", encoded(noise(), "PNG").replace(b"IDAT", b"IDAT\x00", 1), LEFT_OUT),
    _picture("a.jpg", "the bytes of another photo", photo(99), LEFT_OUT, "the same as that of"),
    _zip("a name that leads outside, `../a.jpg`", packed({"../a.jpg": photo()}), LEFT_OUT, "outside"),
    _zip("an absolute name", packed({"/tmp/a.jpg": photo()}), LEFT_OUT, "outside"),
    _zip("a symbolic link", archives.with_link(), LEFT_OUT, "link"),
    _zip(
        "64 MB of zeros in 65 kB",
        lambda: packed({"a.png": bytes(64 * 2**20)}, zipfile.ZIP_DEFLATED),
        LEFT_OUT,
        "bomb",
    ),
    _zip("200 files that share their bytes", archives.overlapping(), LEFT_OUT, "overlaps"),
    _zip("100,000 files", lambda: archives.with_entries(100_000), LEFT_OUT, "list of files"),
    _zip("25,000 files", lambda: archives.with_entries(25_000), LEFT_OUT, "at most 20000"),
    _zip("a zip in a zip", packed({"inner.zip": packed({"a.jpg": photo()})}), LEFT_OUT, "inside a zip"),
    _zip("encrypted", archives.encrypted(), LEFT_OUT, "encrypted"),
    _zip("a wrong checksum", archives.wrong_checksum(), LEFT_OUT, "damaged or cut off"),
    _zip("cut off", packed({"a.jpg": photo()})[:-40], LEFT_OUT, "not a complete zip"),
    _zip("`a`, and `a/b.jpg` below it", packed({"a": b"x", "a/b.jpg": photo()}), LEFT_OUT, "a"),
    _zip("a name of 5,000 bytes", packed({"a" * 5000: photo()}), LEFT_OUT, "too long"),
    _zip("two files of one name", archives.twice(), LEFT_OUT, "two files"),
    _zip("damaged bzip2 data", archives.damaged_bzip2(), LEFT_OUT, "not a complete zip"),
    _zip("no zip at all", b"rubbish" * 100, LEFT_OUT, "not a complete zip"),
    _video("a.mp4", "cut off", lambda: videos.video()[:4000], LEFT_OUT, "does not decode"),
    _video("a.webm", "without a length, as browsers record", videos.without_length, "used", "4 photos"),
    _video(
        "a.mp4",
        "a playlist of other files, called `.mp4`",
        videos.PLAYLIST,
        LEFT_OUT,
        "does not decode as an MP4",
    ),
    _video(
        "a.mp4",
        "a list of files to join, called `.mp4`",
        videos.CONCAT,
        LEFT_OUT,
        "does not decode as an MP4",
    ),
    _video(
        "a.mp4",
        "a codec that does not exist",
        lambda: videos.video().replace(b"avc1", b"zzzz"),
        LEFT_OUT,
        "not known",
    ),
    _video(
        "a.mov",
        "MPEG-TS called `.mov`",
        lambda: videos.video("mpegts"),
        LEFT_OUT,
        "does not decode as an MP4",
    ),
    Hostile("Videos", "frames of 8,208 x 4,336 pixels", _large_video, LEFT_OUT, "35 million pixels"),
    _video("a.mp4", "a photo called `.mp4`", photo(), LEFT_OUT, "does not decode as an MP4"),
)
