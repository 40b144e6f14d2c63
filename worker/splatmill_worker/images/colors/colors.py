"""Colours of videos and photos as sRGB: the primaries and transfer functions that files name by H.273.

What shows no more than SDR white keeps its values. HDR is converted by one fixed rule, so that the frames of all videos
of a capture agree:

- Reference white of ITU-R BT.2408 becomes SDR white: 203 cd/m2 of PQ, and 75 % of the HLG signal. HLG is decoded to the
  light of the scene, which is that of a display of 334 cd/m2, whose system gamma is 1 by BT.2100.
- Colours outside of sRGB approach the grey of the same luminance, until no component is negative.
- A highlight keeps the ratio of its components, and with it its hue: the largest one is compressed from KNEE on.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]
Light = npt.NDArray[np.float32]
Real = npt.NDArray[np.floating[Any]]
Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

BLOCK = 2**15
"""Pixels that are converted at a time: their light stays in the cache of a core."""

STEPS = 2**16
"""Steps of linear light for which the encoded values are kept: in the dark, twenty of them are one level of 255."""

KNEE = 0.83
"""Linear light, of reference white, above which HDR highlights are compressed: the brightest patch of a grey scale
chart (BT.2408, table 1), so that matt surfaces keep their colours."""

REFERENCE_NITS, PQ_NITS = 203.0, 10_000.0
"""Luminance of reference white (BT.2408) and of the largest PQ signal (BT.2100), cd/m2."""

HLG_REFERENCE = 0.75
"""HLG signal of reference white (BT.2408)."""


class Colors(NamedTuple):
    """How the components of a picture are meant.

    primaries: a key of _PRIMARIES, or the chromaticities x, y of white, red, green and blue.
    transfer: a key of _LINEAR, or a power, such as "gamma 1.8".
    """

    primaries: str | tuple[float, ...]
    transfer: str

    def __str__(self) -> str:
        primaries = self.primaries if isinstance(self.primaries, str) else "primaries of its own"
        return primaries if self.transfer in ("sRGB", "gamma 2.2") else f"{primaries}, {self.transfer}"

    @staticmethod
    def of(chromaticities: Sequence[float], gamma: float) -> Colors:
        """The colours of a picture that names x, y of white, red, green and blue, and the power from values to light.

        Those of known names within rounding have the names; damaged ones, and the power 0, count as those of sRGB.
        """
        primaries: str | tuple[float, ...] = tuple(chromaticities)
        for name, points in _PRIMARIES.items():
            known = (*_D65, *points[0], *points[1], *points[2])
            if len(primaries) == len(known) and np.allclose(chromaticities, known, rtol=0.0, atol=SAME_POINT):
                primaries = name
        if not isinstance(primaries, str) and not _usable(primaries):
            primaries = "sRGB"
        if not 0.1 <= gamma <= 10.0 or abs(gamma / SRGB_GAMMA - 1.0) <= SAME_GAMMA:
            return Colors(primaries, "gamma 2.2" if primaries == "Adobe RGB" else "sRGB")
        return Colors(primaries, "linear" if abs(gamma - 1.0) <= SAME_GAMMA else f"gamma {gamma:.3g}")

    @property
    def hdr(self) -> bool:
        """Whether white is not the largest value."""
        return self.transfer in ("HLG", "PQ")


SAME_POINT = 0.005
"""Difference of chromaticities that counts as rounding."""

SRGB_GAMMA, SAME_GAMMA = 2.2, 0.05
"""The power that files name for sRGB, and the relative difference of powers that is not significant, as in libpng."""

SRGB = Colors("sRGB", "sRGB")
ADOBE_RGB = Colors("Adobe RGB", "gamma 2.2")

PRIMARIES = {1: "sRGB", 5: "sRGB", 6: "sRGB", 7: "sRGB", 22: "sRGB"} | {
    9: "BT.2020",
    11: "Display P3",
    12: "Display P3",
}
"""Names of the primaries of H.273. Those of BT.601 (5 to 7 and 22) are taken as sRGB, as players do: cameras name them
for their matrix, and film with the sensors of BT.709. Those of the cinema (11) differ from Display P3 in their white
alone."""

TRANSFERS = dict.fromkeys((1, 4, 5, 6, 7, 11, 12, 13, 14, 15), "sRGB") | {
    8: "linear",
    16: "PQ",
    18: "HLG",
}
"""Names of the transfer functions of H.273. All of SDR are taken as sRGB, as players do: displays show them alike."""

_D65 = (0.3127, 0.3290)
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_PRIMARIES = {
    "sRGB": ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060)),
    "BT.2020": ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    "Display P3": ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
    "Adobe RGB": ((0.640, 0.330), (0.210, 0.710), (0.150, 0.060)),
}
"""Chromaticities x, y of red, green and blue; white is D65."""


def srgb(values: Values, colors: Colors) -> Values:
    """Values [...,3] from 0 to 1 of `colors`, as sRGB values from 0 to 1."""
    light = _linear(values, colors.transfer)
    return _encoded(_shown(light.reshape(-1, 3), colors).clip(0.0, 1.0)).reshape(light.shape)


def srgb_pixels(pixels: Pixels, colors: Colors, white: float = 1.0) -> npt.NDArray[np.uint8]:
    """Pixels [H,W,3] of 8 or 16 bits per channel of `colors`, as those of sRGB of 8 bits: `srgb`, rounded.

    Each pixel is computed: a table of colours with interpolation is off by up to 30 levels for HDR and 16 for SDR with
    wide primaries, since the rule bends between its entries.

    white: the largest value of the pixels over that of their type.
    """
    light = _light(colors.transfer, np.iinfo(pixels.dtype).max, white)
    encoded = _encoded_steps()
    values = np.ascontiguousarray(pixels).reshape(-1, 3)
    converted = np.empty(values.shape, np.uint8)
    for first in range(0, len(values), BLOCK):
        block = slice(first, first + BLOCK)
        shown = _shown(light[values[block]], colors).clip(0.0, 1.0)
        converted[block] = encoded[(shown * np.float32(STEPS) + np.float32(0.5)).astype(np.int32)]
    return converted.reshape(pixels.shape)


@lru_cache(maxsize=4)
def _light(transfer: str, largest: int, white: float) -> Light:
    """The light of each value of pixels up to `largest`."""
    return _linear(np.minimum(np.arange(largest + 1) / (largest * white), 1.0), transfer).astype(np.float32)


@lru_cache(maxsize=1)
def _encoded_steps() -> npt.NDArray[np.uint8]:
    """The sRGB levels of STEPS + 1 values of light from 0 to 1."""
    return np.rint(_encoded(np.arange(STEPS + 1) / STEPS) * 255.0).astype(np.uint8)


def _shown(light: Real, colors: Colors) -> Real:
    """Light [N,3] of `colors`, of white or of reference white, as light of sRGB; rounding may leave it below 0."""
    light = light @ _to_srgb(colors.primaries).T.astype(light.dtype)
    luminance = (light @ _rgb_to_xyz("sRGB")[1].astype(light.dtype)).clip(0.0)[:, None]
    least = light.min(axis=1, keepdims=True)
    kept = np.where(least < 0.0, luminance / np.maximum(luminance - least, 1e-12), 1.0)
    light = luminance + (light - luminance) * kept
    largest = light.max(axis=1, keepdims=True)
    shown: Real = light * (_limited(largest, colors.hdr) / np.maximum(largest, 1e-12))
    return shown


def _encoded(light: Values) -> Values:
    encoded: Values = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return encoded


def _linear(values: Values, transfer: str) -> Values:
    """The light, of white or of HDR's reference white, of values from 0 to 1."""
    if transfer in _LINEAR:
        light: Values = _LINEAR[transfer](values)
        return light
    power: Values = values ** float(transfer.removeprefix("gamma "))
    return power


def _limited(light: Real, hdr: bool) -> Real:
    """Light, of reference white, in 0 to 1: cut off, or of HDR compressed above KNEE, with slope 1 there, towards 1."""
    if not hdr:
        return np.minimum(light, 1.0)
    above = np.maximum(light - KNEE, 0.0) / (1.0 - KNEE)
    limited: Real = np.minimum(light, KNEE) + (1.0 - KNEE) * above / (1.0 + above)
    return limited


def _from_srgb(values: Values) -> Values:
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def _from_hlg(values: Values) -> Values:
    """Light of the scene, of reference white: the inverse OETF of BT.2100."""
    a = 0.17883277
    b = 1.0 - 4.0 * a
    c = 0.5 - a * np.log(4.0 * a)

    def light(signal: Values) -> Values:
        return np.where(signal <= 0.5, signal**2 / 3.0, (np.exp((signal - c) / a) + b) / 12.0)

    return light(values) / light(np.array(HLG_REFERENCE))


def _from_pq(values: Values) -> Values:
    """Light of the display, of reference white: the EOTF of BT.2100."""
    m1, m2 = 2610.0 / 16384.0, 2523.0 / 4096.0 * 128.0
    c1, c2, c3 = 3424.0 / 4096.0, 2413.0 / 4096.0 * 32.0, 2392.0 / 4096.0 * 32.0
    power = values ** (1.0 / m2)
    light: Values = (np.maximum(power - c1, 0.0) / (c2 - c3 * power)) ** (1.0 / m1)
    return light * (PQ_NITS / REFERENCE_NITS)


_LINEAR = {
    "sRGB": _from_srgb,
    "linear": lambda values: values,
    "gamma 2.2": lambda values: values ** (563.0 / 256.0),
    "HLG": _from_hlg,
    "PQ": _from_pq,
}


@lru_cache
def _rgb_to_xyz(primaries: str | tuple[float, ...]) -> Values:
    """Matrix from linear RGB to CIE XYZ, with the luminance 1 for white, which becomes D65 by Bradford's adaptation."""
    if isinstance(primaries, str):
        primaries = (*_D65, *(value for point in _PRIMARIES[primaries] for value in point))
    own_white, *points = zip(primaries[::2], primaries[1::2], strict=True)
    columns, white = np.stack([_xyz(*point) for point in points], axis=1), _xyz(*own_white)
    matrix = columns * np.linalg.solve(columns, white)
    gains = (_BRADFORD @ _xyz(*_D65)) / (_BRADFORD @ white)
    return np.asarray(np.linalg.solve(_BRADFORD, gains[:, None] * (_BRADFORD @ matrix)), np.float64)


def _xyz(x: float, y: float) -> Values:
    return np.array([x / y, 1.0, (1.0 - x - y) / y])


def _usable(chromaticities: tuple[float, ...]) -> bool:
    """Whether chromaticities are those of white and of three primaries that it can be mixed of."""
    points = np.array(chromaticities, np.float64)
    if points.shape != (8,) or not (np.isfinite(points) & (points > -1.0) & (points < 2.0)).all():
        return False
    if points[1::2].min() < 1e-5:
        return False
    x, y = points[2::2], points[3::2]
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    return bool(
        abs(area) > 1e-3 and (np.linalg.solve(np.stack([x, y, 1.0 - x - y]), _xyz(*points[:2])) > 0.0).all()
    )


def _to_srgb(primaries: str | tuple[float, ...]) -> Values:
    """Matrix from linear RGB with other primaries to linear sRGB."""
    return np.asarray(np.linalg.solve(_rgb_to_xyz("sRGB"), _rgb_to_xyz(primaries)), np.float64)
