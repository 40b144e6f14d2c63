"""Proves that copies of a model and of its photos keep what is registered, and leave the model as it was.

On a small model that is written here. Does not prove that COLMAP can adjust a copy: `test_adjust.py` does.
"""

import copy

import numpy as np
import pytest

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.mapping.registered import registered, without_points

PHOTOS, FEATURES = 4, 6


def element(image_id: int, feature: int) -> pycolmap.TrackElement:
    return pycolmap.TrackElement(image_id, feature)


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    """Four photos of one camera. Points 1 and 2 are observed by the first three and the last two of them."""
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=1, model="SIMPLE_RADIAL", width=64, height=48, params=[60.0, 32.0, 24.0, 0.01]
        )
    )
    random = np.random.default_rng(0)
    for image_id in range(1, PHOTOS + 1):
        image = pycolmap.Image(
            name=f"{image_id}.jpg",
            keypoints=random.uniform(0.0, 48.0, (FEATURES, 2)),
            camera_id=1,
            image_id=image_id,
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.1 * image_id, 0.0, 0.0]))
        made.add_image_with_trivial_frame(image, pose)
    made.add_point3D(np.array([0.0, 0.0, 5.0]), pycolmap.Track([element(1, 0), element(2, 3), element(3, 5)]))
    made.add_point3D(np.array([1.0, 0.0, 5.0]), pycolmap.Track([element(3, 1), element(4, 2)]))
    return made


def observed(model: pycolmap.Reconstruction) -> set[tuple[int, int, tuple[float, ...]]]:
    """Image, feature and place of every observation, by the tracks; the photos have to agree."""
    by_track = {
        (each.image_id, each.point2D_idx, tuple(point.xyz))
        for point in model.points3D.values()
        for each in point.track.elements
    }
    by_photo = {
        (image_id, feature, tuple(model.points3D[image.points2D[feature].point3D_id].xyz))
        for image_id, image in model.images.items()
        for feature in image.get_observation_point2D_idxs()
    }
    assert by_track == by_photo
    return by_track


def test_a_photo_for_another_model_has_its_features_and_observes_nothing(
    model: pycolmap.Reconstruction,
) -> None:
    before = model.images[3]
    made = without_points(before)
    assert (made.name, made.image_id, made.camera_id) == ("3.jpg", 3, 1)
    assert [tuple(each.xy) for each in made.points2D] == [tuple(each.xy) for each in before.points2D]
    assert len(made.points2D) == FEATURES
    assert made.num_points3D == 0
    assert not any(each.has_point3D() for each in made.points2D)
    assert before.num_points3D == 2
    assert {each.image_id for each in model.points3D[1].track.elements} == {1, 2, 3}


def test_photos_without_a_pose_are_left_out_and_all_else_stays(model: pycolmap.Reconstruction) -> None:
    whole = observed(model)
    model.deregister_frame(model.images[4].frame_id)
    left = observed(model)
    assert left < whole
    made = registered(model)
    assert (model.num_images(), made.num_images(), made.num_reg_images()) == (4, 3, 3)
    assert observed(made) == left
    for image_id in (1, 2, 3):
        np.testing.assert_array_equal(
            made.images[image_id].cam_from_world().matrix(), model.images[image_id].cam_from_world().matrix()
        )


def test_all_photos_are_copied_where_all_have_a_pose(model: pycolmap.Reconstruction) -> None:
    before = observed(model)
    made = registered(model)
    made.points3D[1].xyz = np.zeros(3)
    made.deregister_frame(made.images[1].frame_id)
    assert observed(model) == before
    assert model.num_reg_images() == PHOTOS


def test_some_photos_get_a_camera_of_their_own_with_the_same_lens(model: pycolmap.Reconstruction) -> None:
    before, lens = observed(model), copy.deepcopy(model.cameras[1].params)
    made = registered(model, camera_id=7, images={2, 4})
    assert {image_id: image.camera_id for image_id, image in made.images.items()} == {1: 1, 2: 7, 3: 1, 4: 7}
    np.testing.assert_array_equal(made.cameras[7].params, lens)
    made.cameras[7].params = [50.0, 32.0, 24.0, 0.0]
    np.testing.assert_array_equal(made.cameras[1].params, lens)
    assert observed(made) == before
    assert {image.camera_id for image in model.images.values()} == {1}
