"""Colours of photos as sRGB: by their ICC profile, by the tags of HEIC and AVIF, or by EXIF."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageCms, ImageFilter

from splatmill_worker.images import guarded
from splatmill_worker.images.colors import (
    ADOBE_RGB,
    PRIMARIES,
    SIDE,
    SRGB,
    TRANSFERS,
    Colors,
    srgb_table,
)

INTEROPERABILITY_IFD, INTEROPERABILITY_INDEX = 0xA005, 1
"""EXIF tags; the index is "R03" for photos in Adobe RGB."""

LIKE_SRGB = 2
"""Largest difference in grey levels of a profile from sRGB that is left as it is: about that of rounding."""

MAX_NAME = 60
"""Characters of the name of a profile that are read."""

_SPACES = {"L": "GRAY", "RGB": "RGB", "RGBA": "RGB", "CMYK": "CMYK", "LAB": "Lab"}
"""The colour space that a profile has for pictures of each mode of Pillow."""


@dataclass(frozen=True)
class PhotoColors:
    """What a photo says of its colours.

    profile: its ICC profile; it is preferred to tags, but for those of HDR.
    tags: the colours that its tags name.
    """

    profile: bytes | None = None
    tags: Colors = SRGB

    @staticmethod
    def of(image: Image.Image, exif: Image.Exif, path: Path) -> PhotoColors:
        """Of a picture that was opened from `path`; nothing is decoded. Damaged tags count as absent."""
        profile, tags = image.info.get("icc_profile"), _tags(image, path)
        if isinstance(profile, bytes) and profile and not tags.hdr:
            return PhotoColors(profile)
        return PhotoColors(tags=ADOBE_RGB if tags == SRGB and _is_adobe_rgb(exif) else tags)

    def remark(self, mode: str) -> str:
        """How the colours of a picture of Pillow's `mode` become sRGB, as a part of a sentence; "" if they are sRGB."""
        if self.profile is None:
            if self.tags.hdr:
                return f"converted to SDR from HDR ({self.tags})"
            return "" if self.tags == SRGB else f"converted to sRGB from {self.tags}"
        transform = _transform(self.profile, mode if mode in _SPACES else Image.getmodebase(mode))
        if transform is None:
            return "taken as sRGB, since their ICC profile is damaged or not one for photos of this kind"
        return transform[0] and f"converted to sRGB from {transform[0]}"

    def srgb(self, photo: Image.Image) -> Image.Image:
        """The photo as sRGB; of the mode RGB or RGBA, unless it is sRGB already."""
        if self.profile is not None:
            transform = _transform(self.profile, photo.mode)
            return _applied(transform[1], photo) if transform and transform[0] else photo
        if self.tags == SRGB:
            return photo
        return (photo if photo.mode == "RGBA" else photo.convert("RGB")).filter(_lookup(self.tags))


def sentences(remarks: Sequence[str]) -> list[str]:
    """Sentences for the user, of what `PhotoColors.remark` says of each photo."""
    counts = Counter(remark for remark in remarks if remark)
    return [f"Colours of {count} of {len(remarks)} photos: {remark}." for remark, count in counts.items()]


def _tags(image: Image.Image, path: Path) -> Colors:
    """The colours that the tags of HEIC, AVIF and PNG name by H.273; those of sRGB where they name none."""
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
    return Colors(PRIMARIES.get(codes[0], "sRGB"), TRANSFERS.get(codes[1], "sRGB"))


def _is_adobe_rgb(exif: Image.Exif) -> bool:
    try:
        return str(exif.get_ifd(INTEROPERABILITY_IFD).get(INTEROPERABILITY_INDEX, "")).startswith("R03")
    except guarded.DECODE_ERRORS:
        return False


@lru_cache(maxsize=4)
def _lookup(colors: Colors) -> ImageFilter.Color3DLUT:
    return ImageFilter.Color3DLUT(SIDE, srgb_table(colors).ravel(), _copy_table=False)


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
