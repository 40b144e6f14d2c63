"""Joins models of one capture that share photos: the mapper starts a new one wherever it loses its way."""

from __future__ import annotations

import copy
from collections.abc import Sequence

from splatmill_worker.colmap import pycolmap

MIN_SHARED = 3  # photos placed by both: fewer do not tell the scale surely
MIN_INLIERS = (
    0.3  # share of a shared photo's points that have to fall where they were seen (COLMAP's default)
)
MAX_PIXELS = 8.0


def merged(models: Sequence[pycolmap.Reconstruction]) -> tuple[pycolmap.Reconstruction, list[int]]:
    """The first model with all the others that can be joined to it, and the indices of those that were.

    All come from one database, so that images, cameras and features go by the same ids. A joined model is moved by
    the similarity under which the shared photos' points agree; its points join those seen at the same features.
    The first model is changed only where one was joined, and then it is a copy. A bundle adjustment should follow.
    """
    whole, joined = models[0], list[int]()
    waiting = list(range(1, len(models)))
    progress = True
    while progress:
        progress = False
        for index in list(waiting):
            similarity = _similarity(models[index], whole)
            if similarity is None:
                continue
            if not joined:
                whole = copy.deepcopy(whole)
            moved = copy.deepcopy(models[index])
            moved.transform(similarity)
            _join(whole, moved)
            joined.append(index)
            waiting.remove(index)
            progress = True  # it may share photos with one that the first did not
    return whole, joined


def _similarity(model: pycolmap.Reconstruction, whole: pycolmap.Reconstruction) -> pycolmap.Sim3d | None:
    """The one that takes `model` into the world of `whole`; None where they share too little or disagree."""
    if len(model.find_common_reg_image_ids(whole)) < MIN_SHARED:
        return None
    return pycolmap.align_reconstructions_via_reprojections(model, whole, MIN_INLIERS, MAX_PIXELS)


def _join(whole: pycolmap.Reconstruction, moved: pycolmap.Reconstruction) -> None:
    """Adds the photos that `whole` lacks, and the points they see, in place; nothing that `whole` has is moved."""
    placed = set(whole.reg_image_ids())
    for image_id in moved.reg_image_ids():
        if image_id in placed:
            continue
        image = moved.images[image_id]
        if image.camera_id not in whole.cameras:
            whole.add_camera_with_trivial_rig(moved.cameras[image.camera_id])
        pose = image.cam_from_world()
        if image_id in whole.images:
            whole.frames[whole.images[image_id].frame_id].set_cam_from_world(image.camera_id, pose)
            whole.register_frame(whole.images[image_id].frame_id)
            continue
        places = pycolmap.Point2DList([pycolmap.Point2D(point.xy) for point in image.points2D])
        fresh = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image_id, points2D=places)
        whole.add_image_with_trivial_frame(fresh, pose)
    for point in moved.points3D.values():
        free, known = [], set()
        for element in point.track.elements:
            feature = whole.images[element.image_id].points2D[element.point2D_idx]
            if feature.has_point3D():
                known.add(feature.point3D_id)
            else:
                free.append(element)
        if len(known) == 1:
            known_id = known.pop()
            seen_by = {element.image_id for element in whole.points3D[known_id].track.elements}
            for element in free:
                if element.image_id not in seen_by:
                    whole.add_observation(known_id, element)
        elif not known and len(free) >= 2:
            whole.add_point3D(point.xyz, pycolmap.Track(free), point.color)
