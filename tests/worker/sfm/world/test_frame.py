"""Proves which frame a reconstruction gets: upright, centred, in units of the photos' distance, or in metres and north
where photos have planted GPS positions; that its matrix leads back to structure from motion; and that a known distance
makes metres.

Not proven here: frames of real photos, which `test_reconstruct` makes of the still life.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from splatmill.schema import KnownDistance
from splatmill_worker.errors import Refusal
from splatmill_worker.images.exif import Exif
from splatmill_worker.scene import Camera, Scene, Similarity, View, viewmat_of
from splatmill_worker.sfm.world import geodesy
from splatmill_worker.sfm.world.frame import choose, in_frame, require_photos

Float = np.ndarray[tuple[int, ...], np.dtype[np.float64]]
LUND = np.array([55.7045, 13.1935, 40.0])
COUNT = 24


def truth(arc: float = 360.0, radius: float = 30.0, pitch: float = 20.0) -> Scene:
    """Cameras on an arc around the origin of a world in metres, x east, y down, z north; the first is in the south."""
    views = []
    for index, angle in enumerate(np.radians(np.linspace(-arc / 2, arc / 2, COUNT, endpoint=arc < 360))):
        height = radius * math.tan(math.radians(pitch))
        center = np.array([radius * math.sin(angle), -height, -radius * math.cos(angle)])
        z = -center / np.linalg.norm(center)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        viewmat = viewmat_of(np.stack([x, np.cross(z, x), z]), center)
        views.append(View(f"{index:02}.jpg", Camera(64, 48, 60, 60, 32, 24, viewmat), Path("none")))
    points = np.random.default_rng(0).normal(size=(100, 3)) * radius / 4
    return Scene(tuple(views), points, np.zeros((100, 3), np.uint8), "sfm")


def from_motion(scene: Scene) -> Scene:
    """The scene in a world of structure from motion: turned, moved and scaled at random."""
    random = np.random.default_rng(5)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    return Similarity(turn, 0.13, random.normal(size=3)).apply(scene)


def gps(scene: Scene, error: float = 0.0, wrong: int = 0, origin: Float = LUND) -> list[Exif]:
    random = np.random.default_rng(7)
    tags = []
    for index, center in enumerate(scene.centers):
        offset = np.array([center[0], center[2], -center[1]]) + random.normal(0, error, 3)
        latitude, longitude, altitude = geodesy.place(offset + (500.0 if index < wrong else 0.0), origin)
        tags.append(Exif(latitude=latitude, longitude=longitude, altitude=altitude))
    return tags


NOTHING = [Exif()] * COUNT


def test_a_scene_stands_upright_and_centred_with_its_photos_at_distance_1() -> None:
    world = truth(arc=120)
    scene = from_motion(world)
    frame = choose(scene, NOTHING)
    moved = in_frame(scene, frame, None)
    assert (frame.unit, frame.origin) == ("arbitrary", None)
    radius = float(np.median(np.linalg.norm(world.centers, axis=1)))
    np.testing.assert_allclose(
        moved.centers * radius, world.centers, atol=1e-6 * radius
    )  # the arc's middle looks to z
    np.testing.assert_allclose(moved.points * radius, world.points, atol=1e-6 * radius)
    for ours, theirs in zip(moved.views, world.views, strict=True):
        np.testing.assert_allclose(ours.camera.viewmat[:3, :3], theirs.camera.viewmat[:3, :3], atol=1e-9)
    assert moved.frame == frame
    assert set(frame.reasons.values()) <= set(moved.notes)
    assert frame.reasons["up"] == f"Up is where {COUNT} of {COUNT} photos are held level."


def test_photos_from_all_around_face_as_the_first_does() -> None:
    moved = in_frame(scene := from_motion(truth()), choose(scene, NOTHING), None)
    assert moved.frame is not None
    assert moved.frame.reasons["heading"] == "z points where 00.jpg looks."
    x, _, z = moved.views[0].camera.axis
    assert abs(x) < 1e-6 < z


def test_the_matrix_leads_back_to_structure_from_motion() -> None:
    scene = from_motion(truth(arc=90))
    moved = in_frame(scene, choose(scene, NOTHING), None)
    assert moved.frame is not None
    back = np.linalg.inv(np.array(moved.frame.from_sfm))
    np.testing.assert_allclose(moved.points @ back[:3, :3].T + back[:3, 3], scene.points, atol=1e-9)


def test_gps_gives_metres_north_and_an_origin() -> None:
    world = truth()
    scene = from_motion(world)
    frame = choose(scene, gps(world, error=1.5, wrong=4))
    assert frame.unit == "metre"
    assert frame.origin is not None
    place = np.array([frame.origin.latitude, frame.origin.longitude, frame.origin.altitude])
    assert np.abs(geodesy.local(place[None], LUND)).max() < 1.5
    moved = in_frame(scene, frame, None)
    assert np.linalg.norm(moved.centers - world.centers, axis=1).max() < 2.0
    assert (
        np.abs(np.linalg.norm(moved.centers, axis=1) / np.linalg.norm(world.centers, axis=1) - 1).max() < 0.05
    )


def test_exact_positions_far_from_the_equator_are_kept_to_a_millimetre() -> None:
    world = truth()
    scene = from_motion(world)
    frame = choose(scene, gps(world, origin=np.array([-77.85, 166.67, 12.5])))
    assert frame.origin is not None
    assert frame.origin.altitude == pytest.approx(12.5, abs=1e-3)
    np.testing.assert_allclose(in_frame(scene, frame, None).centers, world.centers, atol=1e-3)


def test_gps_tells_down_where_photos_from_above_do_not() -> None:
    """Photos from above with one heading look like photos of a wall."""
    world = truth()
    random = np.random.default_rng(2)
    down = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # rows: x east, y south, z down
    centers = np.column_stack([*(random.uniform(-60, 60, (2, COUNT))), random.uniform(-61, -59, COUNT)])[
        :, [0, 2, 1]
    ]
    views = tuple(
        View(view.name, Camera(64, 48, 60, 60, 32, 24, viewmat_of(down, center)), view.image)
        for view, center in zip(world.views, centers, strict=True)
    )
    world = Scene(views, random.normal(size=(50, 3)), np.zeros((50, 3), np.uint8), "sfm")
    scene = from_motion(world)
    frame = choose(scene, gps(world, error=0.5))
    assert frame.reasons["up"] == "Up is upwards by GPS, because the photos alone leave it open."
    axes = np.array([view.camera.axis for view in in_frame(scene, frame, None).views])
    assert axes[:, 1].min() > math.cos(math.radians(3))
    assert "Up is a guess" in choose(scene, NOTHING).reasons["up"]


def test_too_little_ground_leaves_the_unit_open() -> None:
    world = truth(radius=1.5)
    frame = choose(from_motion(world), gps(world, error=3.0))
    assert (frame.unit, frame.origin) == ("arbitrary", None)
    assert "Without GPS: the " in frame.reasons["origin"]


def test_a_known_distance_makes_metres() -> None:
    world = truth(arc=100)
    scene = from_motion(world)
    apart = float(np.linalg.norm(world.centers[3] - world.centers[20]))
    known = KnownDistance("03.jpg", "20.jpg", apart)
    moved = in_frame(scene, choose(scene, NOTHING), known)
    np.testing.assert_allclose(moved.centers, world.centers, atol=1e-6)
    assert moved.frame is not None
    assert moved.frame.unit == "metre"
    assert moved.frame.reasons["unit"] == f"Metres, because 03.jpg and 20.jpg were taken {apart:g} m apart."
    np.testing.assert_allclose(
        Similarity.of(np.array(moved.frame.from_sfm)).points(scene.points), moved.points, atol=1e-9
    )
    located = in_frame(scene, choose(scene, gps(world)), KnownDistance("03.jpg", "20.jpg", 2 * apart))
    assert located.frame is not None
    assert located.frame.reasons["unit"].endswith(f"By GPS it would be {apart:.3g} m.")
    np.testing.assert_allclose(located.centers, 2 * world.centers, atol=1e-2)


def test_distances_that_cannot_be_used() -> None:
    scene = truth()
    frame = choose(scene, NOTHING)
    with pytest.raises(Refusal, match=r"scale names gone\.jpg, whose camera was not recovered"):
        in_frame(scene, frame, KnownDistance("00.jpg", "gone.jpg", 1.0))
    with pytest.raises(Refusal, match="there is no such photo among the 2"):
        require_photos(KnownDistance("a.jpg", "c.jpg", 1.0), ["a.jpg", "b.jpg"])
    twin = View("twin.jpg", scene.views[0].camera, Path("none"))
    with pytest.raises(Refusal, match="their cameras are at one place"):
        in_frame(
            Scene((*scene.views, twin), scene.points, scene.colors, "sfm"),
            frame,
            KnownDistance("00.jpg", "twin.jpg", 1.0),
        )
