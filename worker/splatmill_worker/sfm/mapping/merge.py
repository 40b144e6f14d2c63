"""Merging of models of one capture that share photos; a mapper starts a new model when it cannot go on."""

from __future__ import annotations

import copy
from collections.abc import Sequence

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.mapping.registered import without_points

MIN_SHARED = 3
"""Photos registered in both models; fewer do not determine the scale of the similarity reliably."""

MIN_INLIER_SHARE = 0.3
"""Share of a shared photo's points that must reproject within MAX_REPROJECTION_ERROR; COLMAP's default."""

MAX_REPROJECTION_ERROR = 8.0
"""Pixels; COLMAP's default."""


def merge(models: Sequence[pycolmap.Reconstruction]) -> tuple[pycolmap.Reconstruction, list[int]]:
    """Merge into the first model all those that can be aligned with it.

    Returns the merged model and the indices of the models merged into it. With no such model the first one is
    returned itself, else a copy of it. A bundle adjustment should follow.

    The models must come from one database, so that their images, cameras and features have the same ids. Each is
    aligned by the similarity under which the points of the shared photos agree; its points extend the tracks that
    contain the same features.
    """
    whole, merged = models[0], list[int]()
    waiting = list(range(1, len(models)))
    progress = True
    while progress:
        progress = False
        for index in list(waiting):
            similarity = _similarity(models[index], whole)
            if similarity is None:
                continue
            if not merged:
                whole = copy.deepcopy(whole)
            aligned = copy.deepcopy(models[index])
            aligned.transform(similarity)
            _add(whole, aligned)
            merged.append(index)
            waiting.remove(index)
            progress = True  # its photos may connect further models
    return whole, merged


def _similarity(model: pycolmap.Reconstruction, whole: pycolmap.Reconstruction) -> pycolmap.Sim3d | None:
    """The similarity from the world of `model` to that of `whole`; None when too few photos agree on one."""
    if len(model.find_common_reg_image_ids(whole)) < MIN_SHARED:
        return None
    return pycolmap.align_reconstructions_via_reprojections(
        model, whole, MIN_INLIER_SHARE, MAX_REPROJECTION_ERROR
    )


def _add(whole: pycolmap.Reconstruction, aligned: pycolmap.Reconstruction) -> None:
    """Add to `whole`, in place, the photos it lacks and the points they observe; its own stay where they are."""
    registered = set(whole.reg_image_ids())
    for image_id in aligned.reg_image_ids():
        if image_id in registered:
            continue
        image = aligned.images[image_id]
        if image.camera_id not in whole.cameras:
            whole.add_camera_with_trivial_rig(aligned.cameras[image.camera_id])
        pose = image.cam_from_world()
        if image_id in whole.images:
            whole.frames[whole.images[image_id].frame_id].set_cam_from_world(image.camera_id, pose)
            whole.register_frame(whole.images[image_id].frame_id)
            continue
        whole.add_image_with_trivial_frame(without_points(image), pose)
    for point in aligned.points3D.values():
        free, known = [], set()
        for element in point.track.elements:
            feature = whole.images[element.image_id].points2D[element.point2D_idx]
            if feature.has_point3D():
                known.add(feature.point3D_id)
            else:
                free.append(element)
        if len(known) == 1:
            known_id = known.pop()
            observers = {element.image_id for element in whole.points3D[known_id].track.elements}
            for element in free:
                if element.image_id not in observers:
                    whole.add_observation(known_id, element)
        elif not known and len(free) >= 2:
            whole.add_point3D(point.xyz, pycolmap.Track(free), point.color)
