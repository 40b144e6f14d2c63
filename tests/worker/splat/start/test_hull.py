"""Proves that the visual hull of bodies with exactly known outlines is theirs within a voxel, and that outlines which
bound nothing are refused with the reason.

Does not prove that training gains from such a start: tests/inputs/test_cutouts.py has a whole training.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from splatmill_worker.scene import Camera, viewmat_of
from splatmill_worker.splat.start.hull import Hull, NoHull, at_first, visual_hull
from splatmill_worker.splat.views import Target

SIDE, FOCAL = 160, 200.0
RADIUS, DISTANCE = 0.7, 4.0
MOST = 40_000

Rays = np.ndarray
Body = Callable[[Rays, Rays], np.ndarray]
"""Whether rays from points [3] in directions [n, 3] meet the body [n]."""


def sphere(start: Rays, directions: Rays) -> np.ndarray:
    """A sphere of RADIUS around the origin."""
    across = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    meets: np.ndarray = np.linalg.norm(start - (across @ start)[:, None] * across, axis=1) <= RADIUS
    return meets


def box(*half: float) -> Body:
    """A box around the origin with these halves of its sides."""

    def meets(start: Rays, directions: Rays) -> np.ndarray:
        with np.errstate(divide="ignore"):
            ends = (np.array([[-1.0], [1.0]]) * half - start)[:, None] / directions[None]
        inside: np.ndarray = ends.min(axis=0).max(axis=1) <= ends.max(axis=0).min(axis=1)
        return inside

    return meets


def around(count: int, turn: float = 2 * np.pi) -> list[Camera]:
    """Cameras on a spiral round the origin, which they look at from all heights."""
    cameras = []
    for number in range(count):
        angle = turn * number * (1.0 if turn < 2 * np.pi else 0.382)
        height = 0.9 * np.sin(2.4 * number)
        level = np.sqrt(1.0 - height**2)
        center = DISTANCE * np.array([level * np.cos(angle), level * np.sin(angle), height])
        ahead = -center / np.linalg.norm(center)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(ahead, right), ahead])
        cameras.append(Camera(SIDE, SIDE, FOCAL, FOCAL, SIDE / 2, SIDE / 2, viewmat_of(rotation, center)))
    return cameras


def photo(camera: Camera, body: Body, color: tuple[int, int, int] = (200, 100, 50)) -> Target:
    """The photo of a body, transparent beside it."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    ends = camera.unproject(columns.ravel(), rows.ravel(), np.ones(rows.size))
    alpha = 255 * body(camera.center, ends - camera.center).reshape(rows.shape)
    rgb = np.broadcast_to(np.array(color, np.uint8), (*rows.shape, 3)).copy()
    return Target.of(camera, torch.from_numpy(rgb), torch.from_numpy(alpha.astype(np.uint8)))


def photos(body: Body, count: int = 40) -> list[Target]:
    return [photo(camera, body) for camera in around(count)]


def hull_of(targets: list[Target], most: int = MOST) -> Hull:
    hull = visual_hull(targets, most)
    assert isinstance(hull, Hull), hull
    return hull


def directions(count: int = 100) -> np.ndarray:
    """Random unit vectors [count, 3]."""
    some = np.random.default_rng(0).normal(size=(count, 3))
    unit: np.ndarray = some / np.linalg.norm(some, axis=1, keepdims=True)
    return unit


def off_by(hull: Hull, reach: np.ndarray) -> float:
    """Largest error of how far the hull reaches in each of `directions`, in voxels widened by half a pixel."""
    farthest = (hull.points @ directions().T).max(axis=0)
    return float(np.abs(farthest - reach).max() / (hull.size + 0.5 * DISTANCE / FOCAL))


@pytest.mark.parametrize("most", [2_000, MOST])
def test_the_hull_of_a_sphere_is_the_sphere_within_a_voxel(most: int) -> None:
    hull = hull_of(photos(sphere, 60), most)
    assert off_by(hull, np.full(100, RADIUS)) < 1.0
    assert 0.1 * most < len(hull.points) <= most
    radius = np.linalg.norm(hull.points, axis=1)
    assert radius.max() < RADIUS + hull.size + DISTANCE / FOCAL
    # Even over the volume, which has an eighth within half the radius, and a fifth of the points on the surface.
    assert np.mean(radius < 0.5 * RADIUS) == pytest.approx(0.13, abs=0.03)
    assert np.abs(hull.colors.astype(int) - (200, 100, 50)).max() <= 1
    # The first points are an even choice.
    assert np.abs(hull.points[: len(radius) // 10].mean(axis=0)).max() < 0.15 * RADIUS


def test_the_hull_of_a_cube_is_the_cube_within_a_voxel() -> None:
    hull = hull_of(photos(box(0.6, 0.6, 0.6), 80))
    assert off_by(hull, 0.6 * np.abs(directions()).sum(axis=1)) < 1.5
    # Few photos look along a side, so that the hull bulges there.
    assert np.abs(hull.points).max() < 0.6 + 2.0 * hull.size + DISTANCE / FOCAL


@pytest.mark.parametrize("half", [(0.7, 0.012, 0.012), (0.6, 0.6, 0.01)])
def test_parts_thinner_than_a_voxel_survive(half: tuple[float, float, float]) -> None:
    hull = hull_of(photos(box(*half)), 500)
    assert hull.size > 2 * half[2]
    places = np.histogram(hull.points[:, 0], bins=10, range=(-half[0], half[0]))[0]
    assert places.min() > 0


def test_places_that_a_photo_does_not_show_are_not_carved_by_it() -> None:
    targets = photos(sphere)
    camera = targets[0].camera
    # Aimed past the sphere: half of it is beyond the edge of the frame.
    aside = Camera(SIDE, SIDE, FOCAL, FOCAL, SIDE + 10.0, SIDE / 2, camera.viewmat)
    assert off_by(hull_of([photo(aside, sphere), *targets[1:]]), np.full(100, RADIUS)) < 1.5


def test_what_a_mask_hides_is_not_carved() -> None:
    targets = photos(sphere)
    hidden = torch.ones((SIDE, SIDE), dtype=torch.bool)
    hidden[:, : SIDE // 2] = False
    for number in range(3):
        alpha = targets[number].alpha
        assert alpha is not None
        alpha = alpha.clone()
        alpha[:, : SIDE // 2] = 0
        targets[number] = targets[number]._replace(alpha=alpha, mask=hidden)
    assert off_by(hull_of(targets), np.full(100, RADIUS)) < 1.5


def test_few_wrong_outlines_do_not_carve_the_object_away() -> None:
    targets = photos(sphere, 60)
    for number in (0, 30):
        alpha = targets[number].alpha
        assert alpha is not None
        targets[number] = targets[number]._replace(alpha=255 - alpha)
    targets[7] = targets[7]._replace(alpha=torch.zeros((SIDE, SIDE), dtype=torch.uint8))
    assert off_by(hull_of(targets), np.full(100, RADIUS)) < 1.5


def inverted(targets: list[Target]) -> list[Target]:
    return [target._replace(alpha=None if target.alpha is None else 255 - target.alpha) for target in targets]


@pytest.mark.parametrize(
    ("targets", "reason"),
    [
        pytest.param(lambda: photos(sphere, 1), "1 photos have transparent", id="one photo"),
        pytest.param(
            lambda: [target._replace(alpha=None) for target in photos(sphere, 5)],
            "0 photos have",
            id="opaque",
        ),
        pytest.param(
            lambda: [
                target._replace(alpha=torch.zeros_like(target.rgb[..., 0])) for target in photos(sphere, 5)
            ],
            "0 photos have",
            id="all transparent",
        ),
        pytest.param(lambda: inverted(photos(sphere)), "do not bound an object", id="inverted"),
        pytest.param(
            lambda: [photo(around(1)[0], sphere) for _ in range(6)], "look the same way", id="one camera"
        ),
        pytest.param(lambda: photos(box(9.0, 9.0, 0.02)), "do not bound an object", id="cut by every frame"),
    ],
)
def test_outlines_that_bound_nothing_are_refused_with_the_reason(
    targets: Callable[[], list[Target]], reason: str
) -> None:
    refusal = visual_hull(targets(), MOST)
    assert isinstance(refusal, NoHull)
    assert reason in refusal.reason


def test_outlines_that_contradict_one_another_are_refused() -> None:
    targets = photos(sphere, 12)
    places = np.linspace([-2.0, -2.0, -2.0], [2.0, 2.0, 2.0], 12)

    def elsewhere(place: np.ndarray) -> Body:
        return lambda start, ends: sphere(start - place, ends)

    moved = [photo(camera, elsewhere(place)) for camera, place in zip(around(12), places, strict=True)]
    assert isinstance(visual_hull(targets, MOST), Hull)
    refusal = visual_hull(moved, MOST)
    assert isinstance(refusal, NoHull)


def test_the_first_gaussians_leave_room_for_those_that_training_adds() -> None:
    assert at_first(50_000, 40_000) == 20_000
    assert at_first(500, 40_000) == 500


def test_known_points_come_first_and_colours_stay_with_their_points() -> None:
    hull = hull_of(photos(sphere))
    gaussians = hull.gaussians(50, np.array([[0.0, 0.0, 9.0]]), np.array([[1, 2, 3]], np.uint8))
    assert gaussians.count == 51
    assert gaussians.means[0].tolist() == [0.0, 0.0, 9.0]
    assert torch.equal(gaussians.means[1:], torch.from_numpy(hull.points[:50]).float())
