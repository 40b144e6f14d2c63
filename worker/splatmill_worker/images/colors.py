"""Colours of videos and photos as sRGB: the primaries and transfer functions that files name by H.273.

What shows no more than SDR white keeps its values. HDR is converted by one fixed rule, so that the frames of all videos
of a capture agree:

- Reference white of ITU-R BT.2408 becomes SDR white: 203 cd/m2 of PQ, and 75 % of the HLG signal. HLG is decoded to the
  light of the scene, which is that of a display of 334 cd/m2, whose system gamma is 1 by BT.2100.
- Colours outside of sRGB approach the grey of the same luminance, until no component is negative.
- A highlight keeps the ratio of its components, and with it its hue: the largest one is compressed from KNEE on.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]
Table = npt.NDArray[np.float32]

SIDE = 64
"""Entries along each side of a table of colours: that of a Hald picture of level 8, and at most 65 for Pillow."""

KNEE = 0.83
"""Linear light, of reference white, above which HDR highlights are compressed: the brightest patch of a grey scale
chart (BT.2408, table 1), so that matt surfaces keep their colours."""

REFERENCE_NITS, PQ_NITS = 203.0, 10_000.0
"""Luminance of reference white (BT.2408) and of the largest PQ signal (BT.2100), cd/m2."""

HLG_REFERENCE = 0.75
"""HLG signal of reference white (BT.2408)."""


class Colors(NamedTuple):
    """How the components of a picture are meant: names that are keys of _PRIMARIES and _TRANSFERS."""

    primaries: str
    transfer: str

    def __str__(self) -> str:
        return f"{self.primaries}, {self.transfer}" if self.hdr else self.primaries

    @property
    def hdr(self) -> bool:
        """Whether white is not the largest value."""
        return self.transfer in ("HLG", "PQ")


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
_PRIMARIES = {
    "sRGB": ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060)),
    "BT.2020": ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    "Display P3": ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
    "Adobe RGB": ((0.640, 0.330), (0.210, 0.710), (0.150, 0.060)),
}
"""Chromaticities x, y of red, green and blue; white is D65."""


@lru_cache(maxsize=4)
def srgb_table(colors: Colors, white: float = 1.0) -> Table:
    """The sRGB values, 0 to 1, of the values i / (SIDE - 1), as [blue, green, red, 3]; `white` is the largest one."""
    steps = np.minimum(np.linspace(0.0, 1.0 / white, SIDE), 1.0)
    blue, green, red = np.meshgrid(steps, steps, steps, indexing="ij")
    return srgb(np.stack([red, green, blue], axis=-1), colors).astype(np.float32)


def srgb(values: Values, colors: Colors) -> Values:
    """Values [...,3] from 0 to 1 of `colors`, as sRGB values from 0 to 1."""
    light = _LINEAR[colors.transfer](values) @ _to_srgb(colors.primaries).T
    luminance = light @ _rgb_to_xyz("sRGB")[1]
    least = light.min(axis=-1)
    outside = least < 0.0
    kept = np.where(outside, luminance.clip(0.0) / np.where(outside, luminance.clip(0.0) - least, 1.0), 1.0)
    light = luminance.clip(0.0)[..., None] * (1.0 - kept[..., None]) + light * kept[..., None]
    largest = light.max(axis=-1, keepdims=True)
    light = light * np.where(largest > 0.0, _limited(largest, colors.hdr) / np.maximum(largest, 1e-12), 0.0)
    light = light.clip(0.0, 1.0)
    encoded: Values = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return encoded


def _limited(light: Values, hdr: bool) -> Values:
    """Light, of reference white, in 0 to 1: cut off, or of HDR compressed above KNEE, with slope 1 there, towards 1."""
    if not hdr:
        return np.minimum(light, 1.0)
    above = np.maximum(light - KNEE, 0.0) / (1.0 - KNEE)
    return np.minimum(light, KNEE) + (1.0 - KNEE) * above / (1.0 + above)


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
"""The light, of white or of HDR's reference white, of values from 0 to 1."""


@lru_cache
def _rgb_to_xyz(primaries: str) -> Values:
    """Matrix from linear RGB to CIE XYZ, with the luminance 1 for white."""
    columns = np.array([[x / y, 1.0, (1.0 - x - y) / y] for x, y in _PRIMARIES[primaries]]).T
    white = np.array([_D65[0] / _D65[1], 1.0, (1.0 - sum(_D65)) / _D65[1]])
    return np.asarray(columns * np.linalg.solve(columns, white), np.float64)


def _to_srgb(primaries: str) -> Values:
    """Matrix from linear RGB with other primaries to linear sRGB."""
    return np.asarray(np.linalg.solve(_rgb_to_xyz("sRGB"), _rgb_to_xyz(primaries)), np.float64)
