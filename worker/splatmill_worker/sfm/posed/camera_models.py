"""The camera models that are read from transforms.json and COLMAP models, and what to do about the others."""

from __future__ import annotations

import math
from typing import Any

from splatmill.schema.files.photos import MIN_PHOTO_SIDE
from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.prepare import CUT_PANORAMAS
from splatmill_worker.readers.colmap_files import MODELS

PERSPECTIVE = ("PERSPECTIVE", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Names of camera_model in transforms.json for a pinhole with the distortion k1 to k6, p1 and p2."""

FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
"""Those for an equidistant lens with the distortion k1 to k4."""

PANORAMIC = ("EQUIRECTANGULAR", "SPHERICAL", "LATLONG", "OMNIDIRECTIONALSTEREO", "VR180", "CYLINDRICAL")
"""Beginnings of the names of models whose photos no pinhole camera shows."""

OTHER_LENSES = {"latlong": "LATLONG", "equirectangular": "EQUIRECTANGULAR", "ftheta_p0": "FTHETA"}
"""Fields by which transforms.json of instant-ngp has another lens."""


MIN_FOCAL = 0.02
"""Focal length over the longer side below which intrinsics are not in pixels: a pinhole would show 175 degrees across,
and an equidistant lens more than a whole turn."""


class IntrinsicsNotInPixels(ValueError):
    """Intrinsics of a camera that are given in another unit than pixels or radians. The message has both readings."""


class UnreadModel(ValueError):
    """A camera model that is not read, and what to do about it."""

    def __init__(self, message: str, advice: str) -> None:
        super().__init__(message)
        self.advice = advice

    @staticmethod
    def named(name: str, known: tuple[str, ...]) -> UnreadModel:
        """The error for a model of this name, where `known` ones are read."""
        listed = f"Models that are read are {', '.join(known)}"
        if is_panoramic(name):
            return UnreadModel(
                f"the camera model is {name[:60]}, of panoramas, which no pinhole camera shows. {listed}",
                CUT_PANORAMAS,
            )
        return UnreadModel(
            f"the camera model is {name[:60]}. {listed}",
            "Give undistorted photos with pinhole cameras, which most programs can write, or remove the cameras to "
            "have them recovered from the photos.",
        )


def check_pixels(camera: pycolmap.Camera) -> None:
    """Raise IntrinsicsNotInPixels where the focal lengths or the principal point of a camera can only be parts of the
    sides."""
    width, height = camera.width, camera.height
    focal = min(camera.focal_length_x, camera.focal_length_y)
    place = camera.principal_point_x, camera.principal_point_y
    small = focal < MIN_FOCAL * max(width, height)
    corner = min(place) > 0.0 and max(place) <= 1.0 and min(width, height) >= MIN_PHOTO_SIDE
    if small or corner:
        what = (
            f"the focal length is {focal:.4g}"
            if small
            else f"the principal point is ({place[0]:.4g}, {place[1]:.4g})"
        )
        raise IntrinsicsNotInPixels(
            f"{what} for a photo of {width} x {height} pixels; intrinsics are in pixels. If these are parts of the "
            "sides, multiply those of x by the width, and those of y by the height"
        )


def radians(name: str, angle: float) -> float:
    """The angle of view that the field `name` has. Raises IntrinsicsNotInPixels for one of half a turn or more."""
    if not 0.0 < angle < math.pi:
        raise IntrinsicsNotInPixels(
            f"{name} is {angle:.6g}; it is an angle in radians, and less than pi. If it is in degrees, give "
            f"{math.radians(angle):.6g}"
        )
    return angle


def is_panoramic(name: str) -> bool:
    """Whether the photos of a camera model are panoramas."""
    return name.upper().startswith(PANORAMIC)


def is_fisheye(values: dict[str, Any]) -> bool:
    """Whether the fields of a frame of transforms.json describe a fisheye lens. Raises UnreadModel."""
    name = values.get("camera_model") or "OPENCV"
    for field, model in OTHER_LENSES.items():
        if values.get(field) not in (None, False):
            name = model
    known = str(name).upper()
    if known not in (*PERSPECTIVE, *FISHEYE):
        raise UnreadModel.named(str(name), (*PERSPECTIVE, *FISHEYE))
    return known in FISHEYE or bool(values.get("is_fisheye"))


COLMAP = tuple(name for name, _ in MODELS.values() if not is_panoramic(name))
"""COLMAP's models that are read."""
