"""Positions on the earth (WGS 84) as metres east, north and upwards of an origin, and back, in float64.

Places are latitude and longitude in degrees, and altitude in metres.
"""

from __future__ import annotations

import numpy as np

from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import Float

FAR = 1e6
"""Metres from the origin at which directions are taken, so that the earth's radius costs them no digits."""

_EARTH = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)


def to_earth_centered(origin: Float) -> Float:
    """Matrix [4,4] from metres east, north and up of a place [3] to metres from the earth's centre."""
    *ends, start = _EARTH.enu_to_ecef(np.vstack([FAR * np.eye(3), np.zeros(3)]), *origin)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = ((ends - start) / FAR).T, start
    return matrix


def local(places: Float, origin: Float) -> Float:
    """Metres [n,3] to the east, to the north and upwards of `origin` [3], of places [n,3]."""
    offsets: Float = _EARTH.ellipsoid_to_enu(places, *origin)
    return offsets


def place(offset: Float, origin: Float) -> Float:
    """The place [3] that `local` puts at `offset` [3], to a millimetre but within metres of a pole."""
    there: Float = _EARTH.enu_to_ellipsoid(offset[None], *origin)[0]
    return there
