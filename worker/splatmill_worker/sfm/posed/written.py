"""Cameras and points for other tools: a COLMAP model (binary), transforms.json and its points, in one zip."""

from __future__ import annotations

import json
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from plyfile import PlyData, PlyElement

from splatmill.files import replacing
from splatmill_worker.colmap import pycolmap, write_model
from splatmill_worker.images.lens import PANORAMA, colmap_camera, pixels_of
from splatmill_worker.images.panoramas.faces import joined
from splatmill_worker.scene import Float, Scene, View
from splatmill_worker.sfm.posed.transforms import OPENGL_TO_OPENCV

MODEL = "sparse/0"
"""Folder of the COLMAP model in the zip."""

POINTS = "points3D.ply"
"""Points of transforms.json: x, y and z as float64, and colours."""

_FISHEYE = {"SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 2, "OPENCV_FISHEYE": 4}
_RADIAL = {"SIMPLE_RADIAL": 1, "RADIAL": 2}


def write_cameras(
    path: Path, scene: Scene, viewmats: Mapping[str, Float], offset: Float, held_out: frozenset[str]
) -> None:
    """Write the cameras and points of a scene to a zip, for tools that go on from them.

    viewmats: world-to-camera matrices [4,4] of views whose cameras were refined, by name, in the world of the zip.
    offset: [3], subtracted from the world of `scene` to get to the world of the zip, as in model.ply.
    held_out: names of the views that were held out.

    The cameras are those of the photos as they are, with their lens: a panorama is one photo. Names are those of the
    photos. Where a lens has no counterpart in transforms.json, that file is left out. Raises OSError.
    """
    held_out = frozenset(view.photo for view in scene.views if view.name in held_out)
    scene = joined(scene)
    views = [
        replace(view, camera=replace(view.camera, viewmat=viewmats[view.name]))
        if view.name in viewmats
        else replace(view, camera=view.camera.moved_to(view.camera.center - offset))
        for view in scene.views
    ]
    points = scene.points - offset
    with tempfile.TemporaryDirectory(prefix="splatmill-cameras-") as folder, replacing(path) as part:
        write_model(model_of(views, points, scene), Path(folder))
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for file in sorted(Path(folder).iterdir()):
                archive.write(file, f"{MODEL}/{file.name}")
            document = transforms_of(views, held_out)
            if document is not None:
                archive.writestr("transforms.json", json.dumps(document, indent=1))
                with archive.open(POINTS, "w") as file_in_zip:
                    _points(points, scene.colors).write(file_in_zip)


def model_of(views: list[View], points: Float, scene: Scene) -> pycolmap.Reconstruction:
    """The COLMAP model of views and points [M,3]; colours, errors and tracks are those of `scene`.

    The photos that observe a point are known, and the places where they do are not: they are those of the projection.
    """
    model = pycolmap.Reconstruction()
    ids: dict[tuple[Any, ...], int] = {}
    rows = _observed(views, points, scene)
    cameras = []
    for index, view in enumerate(views):
        camera = camera_of(view)
        key = (camera.model.name, camera.width, camera.height, *camera.params)
        if key not in ids:
            camera.camera_id = ids[key] = len(ids) + 1
            model.add_camera_with_trivial_rig(camera)
        cameras.append(model.cameras[ids[key]])
        local = view.camera.to_camera(points[rows[index]])
        places = pixels_of(cameras[-1], local)
        unseen = ~np.isfinite(places).all(axis=1)
        places[unseen] = np.asarray(cameras[-1].img_from_cam(local[unseen], False), np.float64).reshape(-1, 2)
        image = pycolmap.Image(view.name, places, camera_id=ids[key], image_id=index + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.camera.viewmat[:3]))
    tracks = [pycolmap.Track() for _ in points]
    for index, observed in enumerate(rows):
        for place, point in enumerate(observed.tolist()):
            tracks[point].add_element(index + 1, place)
    for point, track in enumerate(tracks):
        number = model.add_point3D(points[point], track, scene.colors[point])
        if scene.point_errors is not None:
            model.points3D[number].error = float(scene.point_errors[point])
    return model


def camera_of(view: View) -> pycolmap.Camera:
    """The COLMAP camera of the photo of a view, at the size of its file and with its lens."""
    camera = view.camera
    if view.lens is None:
        params = [camera.fx, camera.fy, camera.cx, camera.cy]
        return pycolmap.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=params)
    lens_camera = colmap_camera(view.lens)
    lens_camera.rescale(camera.width, camera.height)
    return lens_camera


def transforms_of(views: list[View], held_out: frozenset[str]) -> dict[str, Any] | None:
    """The document of transforms.json as nerfstudio reads it; None where it has no word for a lens."""
    frames = []
    for view in views:
        lens = _lens(camera_of(view))
        if lens is None:
            return None
        to_world = np.eye(4)
        to_world[:3, :3] = view.camera.viewmat[:3, :3].T
        to_world[:3, 3] = view.camera.center
        matrix = to_world @ OPENGL_TO_OPENCV
        frames.append({"file_path": f"images/{view.name}", **lens, "transform_matrix": matrix.tolist()})
    names = {view.name: f"images/{view.name}" for view in views}
    document: dict[str, Any] = {"ply_file_path": POINTS, "frames": frames}
    tests = [file for name, file in names.items() if name in held_out]
    if tests:
        document["train_filenames"] = [file for name, file in names.items() if name not in held_out]
        document["val_filenames"] = document["test_filenames"] = tests
    return document


def _lens(camera: pycolmap.Camera) -> dict[str, Any] | None:
    """The fields of a frame for a camera."""
    if camera.is_spherical():
        # nerfstudio has both focal lengths as the height.
        side = {"w": camera.width, "h": camera.height, "fl_x": camera.height, "fl_y": camera.height}
        return {"camera_model": PANORAMA, **side, "cx": camera.width / 2, "cy": camera.height / 2}
    name, params = camera.model.name, [float(value) for value in camera.params]
    extra = params[len(params) - len(camera.extra_params_idxs()) :]
    fields: dict[str, Any] = {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.focal_length_x,
        "fl_y": camera.focal_length_y,
        "cx": camera.principal_point_x,
        "cy": camera.principal_point_y,
    }
    if name in _FISHEYE:
        return {"camera_model": "OPENCV_FISHEYE", **fields, **_named(extra, ("k1", "k2", "k3", "k4"))}
    if name in ("SIMPLE_PINHOLE", "PINHOLE"):
        return {"camera_model": "OPENCV", **fields}
    if name in _RADIAL:
        return {"camera_model": "OPENCV", **fields, **_named(extra, ("k1", "k2"))}
    if name in ("OPENCV", "FULL_OPENCV") and not any(extra[6:]):
        return {"camera_model": "OPENCV", **fields, **_named(extra, ("k1", "k2", "p1", "p2", "k3", "k4"))}
    return None


def _named(values: list[float], names: tuple[str, ...]) -> dict[str, float]:
    return dict(zip(names, values, strict=False))


def _observed(views: list[View], points: Float, scene: Scene) -> list[npt.NDArray[np.int64]]:
    """For each view, the indices of the points that it observes; none where that is not known."""
    if scene.point_views is None:
        return [np.zeros(0, np.int64) for _ in views]
    offsets, observers = scene.point_views
    owners = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    order = np.argsort(observers, kind="stable")
    bounds = np.searchsorted(observers[order], np.arange(len(views) + 1))
    return [owners[order[bounds[i] : bounds[i + 1]]].astype(np.int64) for i in range(len(views))]


def _points(points: Float, colors: npt.NDArray[np.uint8]) -> PlyData:
    kinds = [*((axis, "<f8") for axis in "xyz"), *((color, "u1") for color in ("red", "green", "blue"))]
    table = np.zeros(len(points), kinds)
    for index, axis in enumerate("xyz"):
        table[axis] = points[:, index]
    for index, color in enumerate(("red", "green", "blue")):
        table[color] = colors[:, index]
    return PlyData([PlyElement.describe(table, "vertex")], byte_order="<")
