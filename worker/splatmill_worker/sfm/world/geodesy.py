"""Positions on the earth (WGS 84) as metres east, north and upwards of an origin, and back, in float64."""

from __future__ import annotations

import math

import numpy as np

from splatmill_worker.scene import Float

RADIUS = 6378137.0
"""Semi-major axis of the ellipsoid, metres."""

FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_2 = FLATTENING * (2.0 - FLATTENING)
"""Square of the first eccentricity."""


def earth_centered(places: Float) -> Float:
    """Metres from the earth's centre [n,3] of places [n,3]: latitude and longitude in degrees, altitude in metres."""
    latitude, longitude = np.radians(places[:, 0]), np.radians(places[:, 1])
    normal = RADIUS / np.sqrt(1.0 - ECCENTRICITY_2 * np.sin(latitude) ** 2)
    flat = (normal + places[:, 2]) * np.cos(latitude)
    return np.stack(
        [
            flat * np.cos(longitude),
            flat * np.sin(longitude),
            (normal * (1.0 - ECCENTRICITY_2) + places[:, 2]) * np.sin(latitude),
        ],
        axis=1,
    )


def to_earth_centered(origin: Float) -> Float:
    """Matrix [4,4] from metres east, north and up of a place [3] to metres from the earth's centre."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = _axes(origin).T, earth_centered(origin[None])[0]
    return matrix


def local(places: Float, origin: Float) -> Float:
    """Metres [n,3] to the east, to the north and upwards of `origin` [3], of places [n,3] as in `earth_centered`."""
    offsets: Float = (earth_centered(places) - earth_centered(origin[None])) @ _axes(origin).T
    return offsets


def place(offset: Float, origin: Float) -> Float:
    """Latitude, longitude and altitude [3] of a point [3] that `local` puts at `offset`. Millimetres are exact."""
    x, y, z = earth_centered(origin[None])[0] + offset @ _axes(origin)
    longitude, flat = math.atan2(y, x), math.hypot(x, y)
    latitude = math.atan2(z, flat * (1.0 - ECCENTRICITY_2))
    altitude = 0.0
    for _ in range(10):  # converges by a factor of 1 / ECCENTRICITY_2 = 150 a step
        normal = RADIUS / math.sqrt(1.0 - ECCENTRICITY_2 * math.sin(latitude) ** 2)
        altitude = flat * math.cos(latitude) + z * math.sin(latitude) - RADIUS**2 / normal
        latitude = math.atan2(z, flat * (1.0 - ECCENTRICITY_2 * normal / (normal + altitude)))
    return np.array([math.degrees(latitude), math.degrees(longitude), altitude])


def _axes(origin: Float) -> Float:
    """East, north and up at a place [3], as rows [3,3]."""
    latitude, longitude = math.radians(origin[0]), math.radians(origin[1])
    sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
    sin_lon, cos_lon = math.sin(longitude), math.cos(longitude)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
