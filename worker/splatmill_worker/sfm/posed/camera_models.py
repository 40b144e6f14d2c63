"""The camera models that are read from transforms.json and COLMAP models, and what to do about the others."""

from __future__ import annotations

import math
from typing import Any, Literal

from splatmill.schema.files.photos import MIN_PHOTO_SIDE
from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.lens import PANORAMA

PERSPECTIVE = ("PERSPECTIVE", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Names of camera_model in transforms.json for a pinhole with the distortion k1 to k6, p1 and p2."""

FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
"""Those for an equidistant lens with the distortion k1 to k4."""

PANORAMIC = (PANORAMA, "SPHERICAL", "LATLONG", "OMNIDIRECTIONALSTEREO", "VR180", "CYLINDRICAL")
"""Beginnings of the names of models of panoramas, of which PANORAMA itself is read."""

OTHER_LENSES = {"latlong": "LATLONG", "equirectangular": "EQUIRECTANGULAR_EQUAL_AREA", "ftheta_p0": "FTHETA"}
"""Fields by which transforms.json of instant-ngp has another lens. Its equirectangular one has rows of equal area."""

MAX_PANORAMA_ERROR = 0.02
"""Relative difference from 2:1 up to which a panorama shows all directions: sizes are rounded."""

CUT_PANORAMAS = (
    "Give panoramas of 360 by 180 degrees, twice as wide as high, with the camera model EQUIRECTANGULAR; or cut these "
    "into pinhole photos of 90 degrees, the faces of a cube, and give those."
)
"""What to do about panoramas that are not read."""

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
                f"the camera model is {name[:60]}, of other panoramas than those that are read. {listed}",
                CUT_PANORAMAS,
            )
        return UnreadModel(
            f"the camera model is {name[:60]}. {listed}",
            "Give undistorted photos with pinhole cameras, which most programs can write, or remove the cameras to "
            "have them recovered from the photos.",
        )


def panorama(width: int, height: int) -> pycolmap.Camera:
    """The COLMAP camera of a panorama. Raises ValueError for one that does not show all directions."""
    if not abs(width / (2.0 * height) - 1.0) <= MAX_PANORAMA_ERROR + 1.0 / height:
        raise ValueError(
            f"the camera model is {PANORAMA}, and the photo has {width} x {height} pixels: 360 by 180 degrees are "
            "twice as wide as high. If it is a part of a panorama, fill the rest with black and mask it; if it is a "
            "photo of another lens, give the model of that"
        )
    return pycolmap.Camera(model=PANORAMA, width=width, height=height, params=[width, height])


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


def kind_of(values: dict[str, Any]) -> Literal["perspective", "fisheye", "panorama"]:
    """The kind of lens that the fields of a frame of transforms.json describe. Raises UnreadModel."""
    name = values.get("camera_model") or "OPENCV"
    for field, model in OTHER_LENSES.items():
        if values.get(field) not in (None, False):
            name = model
    known = str(name).upper()
    if known == PANORAMA:
        return "panorama"
    if known not in (*PERSPECTIVE, *FISHEYE):
        raise UnreadModel.named(str(name), (*PERSPECTIVE, *FISHEYE, PANORAMA))
    return "fisheye" if known in FISHEYE or values.get("is_fisheye") else "perspective"
