"""Colours of photos as sRGB: by their ICC profile, by the tags of HEIC and AVIF, the chunks of PNG, or EXIF.

In a PNG, the first of cICP, iCCP, sRGB, and gAMA with cHRM that is there holds, as its specification has it.
"""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageCms

from splatmill_worker.images import guarded
from splatmill_worker.images.colors.colors import (
    ADOBE_RGB,
    PRIMARIES,
    SRGB,
    SRGB_GAMMA,
    TRANSFERS,
    Colors,
    srgb_pixels,
)

INTEROPERABILITY_IFD, INTEROPERABILITY_INDEX = 0xA005, 1
"""EXIF tags; the index is "R03" for photos in Adobe RGB."""

EXIF_IFD, COLOR_SPACE, GAMMA = 0x8769, 0xA001, 0xA500
WHITE_POINT, PRIMARY_CHROMATICITIES, TRANSFER_FUNCTION = 0x013E, 0x013F, 0x012D
"""Tags of EXIF and TIFF for colours."""

SRGB_SPACE, ADOBE_SPACE, UNCALIBRATED = 1, 2, 0xFFFF
"""Values of COLOR_SPACE. The second is of some cameras; EXIF has the last for all spaces but sRGB."""

SRGB_POINTS = (0.3127, 0.3290, 0.64, 0.33, 0.30, 0.60, 0.15, 0.06)
"""Chromaticities of white, red, green and blue."""

LIKE_SRGB = 2
"""Largest difference in grey levels of a profile from sRGB that is left as it is: about that of rounding."""

FINE_STEP = 2
"""Grey levels between neighbouring tones that are not reported: curves near that of sRGB have as many by rounding."""

MAX_NAME = 60
"""Characters of the name of a profile that are read."""

_SPACES = {"L": "GRAY", "RGB": "RGB", "RGBA": "RGB", "CMYK": "CMYK", "LAB": "Lab"}
"""The colour space that a profile has for pictures of each mode of Pillow."""


@dataclass(frozen=True)
class PhotoColors:
    """What a photo says of its colours.

    profile: its ICC profile.
    tags: the colours that its tags name.
    assumed: why these may be other than the photo's, as a part of a sentence.
    """

    profile: bytes | None = None
    tags: Colors = SRGB
    assumed: str = ""

    @staticmethod
    def of(image: Image.Image, exif: Image.Exif, path: Path) -> PhotoColors:
        """Of a picture that was opened from `path`; nothing is decoded. Damaged tags count as absent."""
        profile, tags = image.info.get("icc_profile"), _tags(image, path)
        if (
            isinstance(profile, bytes)
            and profile
            and not (tags is not None and (tags.hdr or image.format == "PNG"))
        ):
            return PhotoColors(profile)
        if tags is not None:
            return PhotoColors(tags=tags)
        if image.format == "PNG" and (named := _chunks(image)) is not None:
            return PhotoColors(tags=named)
        if image.mode == "F":
            return PhotoColors(assumed="numbers from 0 to 1 taken as values of sRGB, and not as linear light")
        named = _exif_colors(exif)
        if named is None:
            other = (
                "taken as sRGB, since their EXIF says that they are in another colour space and names none"
            )
            return PhotoColors(assumed=other)
        return PhotoColors(tags=named)

    def remark(self, mode: str) -> str:
        """How the colours of a picture of Pillow's `mode` become sRGB, and whether tones are lost, as a part of a
        sentence; "" if they are sRGB."""
        conversion = self._conversion(mode)
        step = self.largest_step(mode) if conversion and Image.getmodebase(mode) in ("L", "RGB") else 0
        if step <= FINE_STEP:
            return conversion
        return (
            f"{conversion}; photos are read with 8 bits, so that neighbouring tones are up to {step} of 255 levels "
            "apart and may show as bands: save such photos with the curve of sRGB"
        )

    def largest_step(self, mode: str = "RGB") -> int:
        """Grey levels of sRGB between neighbouring ones of a picture of `mode`, at most."""
        ramp = Image.fromarray(np.arange(256, dtype=np.uint8)[None]).convert(Image.getmodebase(mode))
        grey = np.asarray(self.srgb(ramp).convert("RGB"), int)[0, :, 1]
        return int(np.diff(grey).max())

    def _conversion(self, mode: str) -> str:
        """How the colours of a picture of `mode` become sRGB, as a part of a sentence."""
        if self.profile is None:
            if self.tags.hdr:
                return f"converted to SDR from HDR ({self.tags})"
            if mode == "CMYK":
                return "converted to sRGB from CMYK without an ICC profile, so that they are approximate"
            return self.assumed if self.tags == SRGB else f"converted to sRGB from {self.tags}"
        transform = _transform(self.profile, mode if mode in _SPACES else Image.getmodebase(mode))
        if transform is None:
            return "taken as sRGB, since their ICC profile is damaged or not one for photos of this kind"
        return transform[0] and f"converted to sRGB from {transform[0]}"

    def srgb(self, photo: Image.Image, mode: str | None = None) -> Image.Image:
        """The photo as sRGB; of the mode RGB or RGBA, unless it is sRGB already.

        mode: that of the file, of which `photo` may have another; None: the same.
        """
        if photo.mode == "LAB" and not (self.profile and _transform(self.profile, "LAB")):
            return _by_profile(_lab_profile(), photo, "LAB")
        if self.profile is not None:
            return _by_profile(self.profile, photo, mode or photo.mode)
        if self.tags == SRGB:
            return photo
        converted = Image.fromarray(srgb_pixels(np.asarray(photo.convert("RGB")), self.tags))
        if photo.mode == "RGBA":
            converted.putalpha(photo.getchannel("A"))
        return converted


def sentences(remarks: Sequence[str]) -> list[str]:
    """Sentences for the user, of what `PhotoColors.remark` says of each photo."""
    counts = Counter(remark for remark in remarks if remark)
    return [f"Colours of {count} of {len(remarks)} photos: {remark}." for remark, count in counts.items()]


def _tags(image: Image.Image, path: Path) -> Colors | None:
    """The colours that the tags of HEIC, AVIF and PNG name by H.273; None where they name none."""
    codes: tuple[int, int]
    if image.format == "AVIF":
        codes = guarded.avif_tags(path)
    elif image.format == "PNG":
        codes = guarded.png_tags(path)
    else:
        nclx = image.info.get("nclx_profile") or {}
        codes = (
            int(nclx.get("color_primaries", guarded.UNSPECIFIED)),
            int(nclx.get("transfer_characteristics", guarded.UNSPECIFIED)),
        )
    if codes == (guarded.UNSPECIFIED, guarded.UNSPECIFIED):
        return None
    return Colors(PRIMARIES.get(codes[0], "sRGB"), TRANSFERS.get(codes[1], "sRGB"))


def _chunks(image: Image.Image) -> Colors | None:
    """The colours that the chunks sRGB, or else gAMA and cHRM, of a PNG name; None without any of them."""
    if "srgb" in image.info:
        return SRGB
    gamma, points = image.info.get("gamma"), image.info.get("chromaticity")
    if not gamma and points is None:
        return None
    return Colors.of(points or SRGB_POINTS, 1.0 / gamma if gamma else SRGB_GAMMA)


def _exif_colors(exif: Image.Exif) -> Colors | None:
    """The colours that EXIF, or the tags of TIFF, name: sRGB without any; None if they are others without a name."""
    try:
        space = exif.get_ifd(EXIF_IFD).get(COLOR_SPACE)
        index = str(exif.get_ifd(INTEROPERABILITY_IFD).get(INTEROPERABILITY_INDEX, ""))
        if index.startswith("R03") or space == ADOBE_SPACE:
            return ADOBE_RGB
        if space == SRGB_SPACE:
            return SRGB
        white, points = exif.get(WHITE_POINT), exif.get(PRIMARY_CHROMATICITIES)
        gamma = exif.get_ifd(EXIF_IFD).get(GAMMA) or _gamma_of(exif.get(TRANSFER_FUNCTION))
        if white is not None and points is not None:
            return Colors.of([float(value) for value in (*white, *points)], float(gamma or SRGB_GAMMA))
        if gamma:
            return Colors.of(SRGB_POINTS, float(gamma))
    except guarded.DECODE_ERRORS:
        return SRGB
    return None if space == UNCALIBRATED else SRGB


def _gamma_of(table: Any) -> float | None:
    """The power of a table of TIFF from values to light, by its middle; None without a table that has one."""
    if not isinstance(table, tuple) or len(table) < 256:
        return None
    # Three channels have a table each.
    one = table[: len(table) // 3] if len(table) % 3 == 0 else table
    light = float(one[len(one) // 2]) / 65535.0
    return math.log(light) / math.log(0.5) if 0.0 < light < 1.0 else None


@lru_cache(maxsize=1)
def _lab_profile() -> bytes:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()


def _by_profile(profile: bytes, photo: Image.Image, mode: str) -> Image.Image:
    """A photo of a file of `mode`, converted by its profile where that is one for such files."""
    transform = _transform(profile, photo.mode)
    if transform is not None:
        return _applied(transform[1], photo) if transform[0] else photo
    if Image.getmodebase(mode) != "L" or photo.mode not in ("RGB", "RGBA"):
        return photo
    # Grey pictures with transparent pixels, and those of two values, come as RGB or RGBA.
    grey = _transform(profile, "L")
    if grey is None or not grey[0]:
        return photo
    converted = _applied(grey[1], photo.getchannel("R"))
    if photo.mode == "RGBA":
        converted.putalpha(photo.getchannel("A"))
    return converted


@lru_cache(maxsize=16)
def _transform(profile: bytes, mode: str) -> tuple[str, ImageCms.ImageCmsTransform] | None:
    """What makes sRGB of a picture of `mode`, and the name of its profile, which is "" if the profile is that of sRGB;
    None where the profile is damaged or one for other pictures."""
    try:
        opened = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if opened.profile.xcolor_space.strip() != _SPACES.get(mode):
            return None
        transform = ImageCms.buildTransform(
            opened,
            ImageCms.createProfile("sRGB"),
            mode,
            "RGBA" if mode == "RGBA" else "RGB",
            ImageCms.Intent.RELATIVE_COLORIMETRIC,
            # Threads share the transform; without its cache, LittleCMS lets them.
            ImageCms.Flags.BLACKPOINTCOMPENSATION | ImageCms.Flags.NOCACHE,
        )
        name = ImageCms.getProfileDescription(opened).strip()[:MAX_NAME] or "an ICC profile without a name"
        if mode in ("L", "RGB", "RGBA"):
            steps = np.linspace(0, 255, 17).astype(np.uint8)
            colors = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(17, -1, 3)
            before = Image.fromarray(colors).convert(mode)
            after = _applied(transform, before)
            change = np.asarray(after.convert("RGB"), int) - np.asarray(before.convert("RGB"), int)
            name = name if np.abs(change).max() > LIKE_SRGB else ""
    except (ImageCms.PyCMSError, *guarded.DECODE_ERRORS):
        return None
    return name, transform


def _applied(transform: ImageCms.ImageCmsTransform, photo: Image.Image) -> Image.Image:
    converted = ImageCms.applyTransform(photo, transform)
    assert converted is not None
    return converted
