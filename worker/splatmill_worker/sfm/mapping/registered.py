"""A copy of a COLMAP model without the photos that it has not registered."""

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
        points = pycolmap.Point2DList([pycolmap.Point2D(point.xy) for point in image.points2D])
        copied = pycolmap.Image(
            name=image.name,
            camera_id=camera_id if image_id in images else image.camera_id,
            image_id=image_id,
            points2D=points,
        )
        result.add_image_with_trivial_frame(copied, image.cam_from_world())
    for point in model.points3D.values():
        result.add_point3D(point.xyz, point.track, point.color)
    return result
