"""A COLMAP model that came with photos: its cameras and poses, checked, and its points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import Refusal
from splatmill_worker.images.decoding import decoders
from splatmill_worker.readers import colmap_files
from splatmill_worker.readers.colmap_files import Arrays
from splatmill_worker.readers.programs.shots import rotation_of_quaternion
from splatmill_worker.sfm.posed import camera_models
from splatmill_worker.sfm.posed.camera_models import IntrinsicsNotInPixels

MAX_SIDE = 1_000_000
"""Pixels of a side of a camera."""

MAX_PARAMETER = 1e7
"""Largest parameter of a camera: a focal length or a coordinate in pixels, or a coefficient of the lens."""

MAX_DISTANCE = 1e12
"""Distance of a camera from the origin, in units of the model: squares of it are exact enough."""

MOST_FAULTY = 0.1
"""Share of the poses of a file that are left out where no photo can have them; more are a fault of the file."""

Float = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ModelPoints:
    """The points of a COLMAP model.

    positions: [N,3]. colors: uint8 [N,3]. errors: reprojection errors in pixels [N].
    offsets, images: the track of point i are the images with the ids `images[offsets[i]:offsets[i + 1]]`, which may
        repeat.
    """

    positions: Float
    colors: npt.NDArray[np.uint8]
    errors: Float
    offsets: npt.NDArray[np.int64]
    images: npt.NDArray[np.int64]

    @staticmethod
    def of(model: pycolmap.Reconstruction) -> ModelPoints:
        """The points of a model in memory."""
        points = list(model.points3D.values())
        tracks = [[element.image_id for element in point.track.elements] for point in points]
        return ModelPoints(
            np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
            np.array([point.color for point in points], np.uint8).reshape(-1, 3),
            np.array([point.error for point in points], np.float64),
            np.cumsum([0, *map(len, tracks)], dtype=np.int64),
            np.array([image for track in tracks for image in track], np.int64),
        )


@dataclass(frozen=True)
class GivenImage:
    """A photo of a given model: its name, its camera, and its world-to-camera matrix [4,4].

    The camera is a function of the width and height of the photo where the file does not have these.

    In a name that is not UTF-8, other bytes are surrogates: see `encodings.decoded`.
    """

    name: str
    camera: pycolmap.Camera | Callable[[int, int], pycolmap.Camera]
    viewmat: Float


@dataclass(frozen=True)
class GivenModel:
    """A COLMAP model that came with photos; the images by their ids.

    faulty: name, and what is wrong, of the images that are left out.
    what: the model in a sentence.
    """

    images: dict[int, GivenImage]
    points: ModelPoints
    faulty: tuple[tuple[str, str], ...] = ()
    what: str = "the COLMAP model"


def read(folder: Path) -> GivenModel:
    """The model in `folder`, as .bin or as .txt; without points where points3D is missing or empty.

    Raises ValueError, naming the file or the entry, when a file is missing, too large, damaged or contradicts another,
    and when a camera or a pose is not valid.
    """
    which = colmap_files.which(folder)

    def fault(code: str, name: str, reason: str) -> Exception:
        message = f"{which} could not be read: {reason}."
        if code != "decoder_ended":
            return ValueError(message)
        return Refusal(code, message, advice="Restart the job, or remove the poses.")

    arrays = decoders.call_once(colmap_files.read, folder, check=_arrays, fault=fault)
    images, faulty = _images(arrays, _cameras(arrays))
    return GivenModel(images, _points(arrays), faulty)


def _arrays(answer: Any) -> Arrays:
    """The arrays that `colmap_files.read` returns. Raises ValueError and KeyError for others."""
    cameras, images = len(answer["camera_ids"]), len(answer["image_ids"])
    points, tracks = len(answer["points"]), len(answer["track_images"])
    offsets = answer["track_offsets"]
    shapes = {
        "camera_ids": (cameras,),
        "camera_models": (cameras,),
        "camera_sizes": (cameras, 2),
        "camera_params": (cameras, colmap_files.MOST_PARAMETERS),
        "image_ids": (images,),
        "image_cameras": (images,),
        "image_poses": (images, 7),
        "image_names": (len(answer["image_names"]),),
        "points": (points, 3),
        "colors": (points, 3),
        "errors": (points,),
        "track_offsets": (points + 1,),
        "track_images": (tracks,),
    }
    if any(answer[name].shape != shape for name, shape in shapes.items()):
        raise ValueError("an array has another shape")
    if offsets[0] != 0 or offsets[-1] != tracks or (np.diff(offsets) < 0).any():
        raise ValueError("the tracks are not in order")
    if not set(np.unique(answer["camera_models"]).tolist()) <= colmap_files.MODELS.keys():
        raise ValueError("there is no such camera model")
    if int((answer["image_names"] == 0).sum()) != images:
        raise ValueError("there is not a name for each image")
    return {name: answer[name] for name in shapes}


def _cameras(arrays: Arrays) -> dict[int, pycolmap.Camera]:
    """The cameras by their ids. Raises ValueError for one with which no photo can have been taken."""
    cameras: dict[int, pycolmap.Camera] = {}
    for number, kind, (width, height), values in zip(
        arrays["camera_ids"].tolist(),
        arrays["camera_models"].tolist(),
        arrays["camera_sizes"].tolist(),
        arrays["camera_params"],
        strict=True,
    ):
        name, count = colmap_files.MODELS[kind]
        parameters = values[:count].astype(np.float64)
        if number in cameras:
            raise ValueError(f"The COLMAP model has two cameras {number}.")
        if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
            raise ValueError(
                f"Camera {number} of the COLMAP model has {width} x {height} pixels; a side has 1 to {MAX_SIDE}."
            )
        camera = pycolmap.Camera(model=name, width=width, height=height, params=parameters)
        if camera.is_spherical():
            try:
                cameras[number] = camera_models.panorama(width, height)
            except ValueError as error:
                raise ValueError(f"Camera {number} of the COLMAP model: {error}.") from error
            continue
        focal = [parameters[index] for index in camera.focal_length_idxs()]
        if not (np.abs(parameters).max() <= MAX_PARAMETER and min(focal, default=1.0) > 0.0):
            raise ValueError(f"Camera {number} of the COLMAP model has the parameters {parameters.tolist()}.")
        try:
            camera_models.check_pixels(camera)
        except IntrinsicsNotInPixels as error:
            raise IntrinsicsNotInPixels(f"Camera {number} of the COLMAP model: {error}.") from error
        cameras[number] = camera
    return cameras


def _images(
    arrays: Arrays, cameras: dict[int, pycolmap.Camera]
) -> tuple[dict[int, GivenImage], tuple[tuple[str, str], ...]]:
    """The images by their ids, and those that are left out because no photo can have their pose.

    Raises ValueError, naming the first, when these are more than MOST_FAULTY of all.
    """
    images: dict[int, GivenImage] = {}
    faulty: list[tuple[str, str]] = []
    names = arrays["image_names"].tobytes().decode("utf-8", "surrogateescape").split("\0")[:-1]
    for number, of, pose, name in zip(
        arrays["image_ids"].tolist(),
        arrays["image_cameras"].tolist(),
        arrays["image_poses"],
        names,
        strict=True,
    ):
        quat, translation = pose[:4], pose[4:7]
        if number in images:
            raise ValueError(f"The COLMAP model has two images {number}.")
        if of not in cameras:
            raise ValueError(
                f"The COLMAP model could not be read: {name!r} has the camera {of}, which is missing."
            )
        fault = ""
        viewmat = np.eye(4)
        try:
            viewmat[:3, :3] = rotation_of_quaternion(*quat.tolist())
        except ValueError as error:
            fault = f"The rotation of {name!r} in the COLMAP model is not valid: {error}."
        if not fault and not (np.abs(translation) <= MAX_DISTANCE).all():
            fault = (
                f"The translation of {name!r} in the COLMAP model is not valid, or too large: {translation}."
            )
        if fault:
            faulty.append((name, fault))
            if len(faulty) > MOST_FAULTY * len(names):
                raise ValueError(faulty[0][1])
            continue
        viewmat[:3, 3] = translation
        images[number] = GivenImage(name, cameras[of], viewmat)
    return images, tuple(faulty)


def _points(arrays: Arrays) -> ModelPoints:
    """The points. Raises ValueError for a track with an image that the model does not have."""
    points = ModelPoints(
        *(arrays[name] for name in ("points", "colors", "errors", "track_offsets", "track_images"))
    )
    unknown = np.setdiff1d(points.images, arrays["image_ids"])
    if len(unknown):
        raise ValueError(
            f"The COLMAP model could not be read: points are observed by image {unknown[0]}, which is missing."
        )
    return points
