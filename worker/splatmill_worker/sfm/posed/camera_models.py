"""The camera models that are read from transforms.json and COLMAP models, and what to do about the others."""

from __future__ import annotations

from typing import Any

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
