"""The flight over the town: cameras in strips there and back, and the positions that a GPS receiver measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Camera, viewmat_of

Float = npt.NDArray[np.float64]

LATITUDE, LONGITUDE, ALTITUDE = 48.1, 11.5, 510.0
"""Where the origin lies: in degrees, and metres above sea level."""

EQUATOR, ECCENTRICITY = 6378137.0, 0.0066943799901413165
"""Of the ellipsoid of WGS 84: its radius at the equator, in metres, and the square of its eccentricity."""


@dataclass(frozen=True)
class Flight:
    """How the photos are taken.

    height: above the ground, in metres.
    forward, side: share of a photo's ground that the next one in the strip shows, and that of the next strip; of the
    ground as seen straight down.
    tilt: of the view, forward from straight down, in degrees.
    drift: standard deviation of a camera's place from the planned one along each axis, in metres.
    sway: standard deviation of its roll, pitch and yaw, in degrees.
    gps: standard deviation of the measured east and north, in metres; that of the altitude is twice as large.
    """

    height: float = 60.0
    forward: float = 0.78
    side: float = 0.65
    tilt: float = 15.0
    drift: float = 0.7
    sway: float = 1.5
    gps: float = 1.5

    def cameras(self, count: int, width: int, height: int, seed: int) -> list[Camera]:
        """`count` cameras in the order in which the photos are taken, over an area as large as their number asks for.

        width, height: of the photos, in pixels. The world has x east, y north and z up, in metres, with the origin on
        the ground in the middle of the area.
        """
        random = np.random.default_rng([seed, 23])
        focal = 0.75 * max(width, height)
        along, across = (
            (1 - self.forward) * self.height * height / focal,
            (1 - self.side) * self.height * width / focal,
        )
        strips = max(1, round(math.sqrt(count * along / across)))
        lengths = [count // strips + (k < count % strips) for k in range(strips)]
        cameras = []
        for strip, length in enumerate(lengths):
            heading = 1.0 if strip % 2 == 0 else -1.0
            for k in range(length):
                north = heading * (k - (length - 1) / 2) * along
                place = np.array([(strip - (strips - 1) / 2) * across, north, self.height])
                place += random.normal(0.0, self.drift, 3)
                # The camera looks ahead of the nadir by the tilt: what it shows lies below its place on average.
                place[1] -= heading * self.height * math.tan(math.radians(self.tilt))
                roll, pitch, yaw = np.radians(random.normal(0.0, self.sway, 3))
                rotation = _attitude(heading, math.radians(self.tilt) + pitch, roll, yaw)
                viewmat = viewmat_of(rotation, place)
                cameras.append(Camera(width, height, focal, focal, width / 2, height / 2, viewmat))
        return cameras

    def measured(self, cameras: list[Camera], seed: int) -> Float:
        """Latitude and longitude in degrees, altitude in metres [n, 3] of the cameras, as a receiver measured them."""
        random = np.random.default_rng([seed, 24])
        spread = np.array([self.gps, self.gps, 2 * self.gps])
        places = np.array([camera.center for camera in cameras])
        return geodetic(places + random.normal(size=places.shape) * spread)


def geodetic(places: Float) -> Float:
    """Latitude and longitude in degrees and altitude in metres [n, 3] of places [n, 3] in the world, in metres."""
    north, east = _radii()
    latitude = LATITUDE + np.degrees(places[:, 1] / north)
    longitude = LONGITUDE + np.degrees(places[:, 0] / (east * math.cos(math.radians(LATITUDE))))
    return np.stack([latitude, longitude, ALTITUDE + places[:, 2]], axis=1)


def local(measured: Float) -> Float:
    """The inverse of `geodetic`: places [n, 3] in the world, in metres."""
    north, east = _radii()
    x = np.radians(measured[:, 1] - LONGITUDE) * east * math.cos(math.radians(LATITUDE))
    y = np.radians(measured[:, 0] - LATITUDE) * north
    return np.stack([x, y, measured[:, 2] - ALTITUDE], axis=1)


def _radii() -> tuple[float, float]:
    """Radii of the ellipsoid at the origin along the meridian and across it, in metres."""
    flat = 1.0 - ECCENTRICITY * math.sin(math.radians(LATITUDE)) ** 2
    return EQUATOR * (1.0 - ECCENTRICITY) / flat**1.5, EQUATOR / math.sqrt(flat)


def _attitude(heading: float, tilt: float, roll: float, yaw: float) -> Float:
    """World-to-camera rotation [3, 3] of a camera above the ground that flies north (1) or south (-1).

    tilt: of the view from straight down towards where it flies; all in radians.
    """
    right, ahead, down = (
        np.array([heading, 0.0, 0.0]),
        np.array([0.0, heading, 0.0]),
        np.array([0.0, 0.0, -1.0]),
    )
    level = np.stack([right, -ahead, down])
    rotation: Float = _about(0, -tilt) @ _about(1, roll) @ _about(2, yaw) @ level
    return rotation


def _about(axis: int, angle: float) -> Float:
    """The rotation [3, 3] about a coordinate axis by `angle` radians."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.eye(3)
    rotation[a, a] = rotation[b, b] = math.cos(angle)
    rotation[a, b], rotation[b, a] = -math.sin(angle), math.sin(angle)
    return rotation
