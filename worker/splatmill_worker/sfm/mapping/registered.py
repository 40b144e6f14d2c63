"""Copies of a COLMAP model without the photos that it has not registered, and of a photo for another model."""

from __future__ import annotations

import copy
from collections.abc import Collection

from splatmill_worker.colmap import pycolmap


def registered(
    model: pycolmap.Reconstruction, camera_id: int | None = None, images: Collection[int] = ()
) -> pycolmap.Reconstruction:
    """The registered photos of `model`, with their cameras, poses and points.

    camera_id: a new camera for the photos with the ids `images`, which had one camera; it begins with their lens.
    """
    if camera_id is None and model.num_reg_images() == model.num_images():
        return copy.deepcopy(model)
    result = pycolmap.Reconstruction()
    for camera in model.cameras.values():
        result.add_camera_with_trivial_rig(camera)
    if camera_id is not None:
        added = copy.deepcopy(model.cameras[model.images[next(iter(images))].camera_id])
        added.camera_id = camera_id
        result.add_camera_with_trivial_rig(added)
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        copied = without_points(image)
        if camera_id is not None and image_id in images:
            copied.camera_id = camera_id
        result.add_image_with_trivial_frame(copied, image.cam_from_world())
    for point in model.points3D.values():
        result.add_point3D(point.xyz, point.track, point.color)
    return result


def without_points(image: pycolmap.Image) -> pycolmap.Image:
    """A copy of a photo with its features, none of which observes a point, to be added to another model."""
    # COLMAP copies the features at once; a photo has thousands of them.
    copied = pycolmap.Image(
        name=image.name, camera_id=image.camera_id, image_id=image.image_id, points2D=image.points2D
    )
    for feature in image.get_observation_point2D_idxs():
        copied.reset_point3D_for_point2D(feature)
    return copied
