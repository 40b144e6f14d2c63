"""Proves that planted exposures, tints and jumps are recovered from what photos see, and that smooth light is left in.

Does not prove that photos with corrected light train better: `bench train` measures that.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from splatmill_worker.scene import PointViews, Scene
from splatmill_worker.splat.plan.facts import measure
from splatmill_worker.splat.plan.light import TOGETHER, Light, compared, divided
from splatmill_worker.splat.plan.observations import Observations
from splatmill_worker.splat.views import Target, TrainingView
from splatmill_worker.synthetic import look_at
from splatmill_worker.synthetic.light import Light as PlantedLight
from tests.support import still_life
from tests.support.training import sparse_scene


def lit(gains: np.ndarray) -> tuple[Scene, list[TrainingView]]:
    """The still life with one point in five, its photos multiplied by `gains` [n, 3]."""
    world, views = sparse_scene()
    for view, gain in zip(views, gains, strict=True):
        taken = PlantedLight().falling_on(view.full.rgb.numpy(), gain)
        view.full.rgb.copy_(torch.from_numpy(taken))
    return world, views


def light(gains: np.ndarray) -> Light:
    return light_of(*lit(gains))


def light_of(scene: Scene, views: list[TrainingView]) -> Light:
    observations = Observations.of(scene, views)
    assert observations is not None
    lighting = compared(observations, views)
    assert lighting is not None
    return lighting


def ring(photos: int) -> list[TrainingView]:
    """Views of a ring of cameras that look at its middle; their photos are never read."""
    views: list[TrainingView] = []
    for turn in 2 * np.pi * np.arange(photos) / photos:
        camera = look_at(np.array([3 * np.cos(turn), 3 * np.sin(turn), 1.0]), np.zeros(3), 8, 6, 7.0)
        target = Target(
            camera, torch.eye(4), torch.eye(3), torch.zeros(6, 8, 3, dtype=torch.uint8), None, None
        )
        views.append(TrainingView(f"{len(views):02d}.png", {1: target}))
    return views


def on_a_ring(photos: int, exposures: np.ndarray) -> Light:
    """The light of a ring of photos of one flat grey, each seeing the same 60 points, with these exposures [n, 3]."""
    points = 60
    grey = np.linspace(70.0, 110.0, points)
    color = (grey[None, :, None] * np.exp(exposures)[:, None, :] + 0.5).astype(np.uint8)
    directions = np.zeros((photos * points, 3))
    observations = Observations(
        points,
        photos,
        np.tile(np.arange(points), photos),
        np.repeat(np.arange(photos), points),
        color.reshape(-1, 3),
        np.ones(photos * points),
        directions,
    )
    lighting = compared(observations, ring(photos))
    assert lighting is not None
    return lighting


def test_equal_light_departs_by_less_than_the_noise() -> None:
    lighting = light(np.ones((14, 3)))
    assert lighting.tail < 3 * lighting.error + 0.03
    assert np.abs(lighting.exposures.mean(axis=0)).max() < 1e-9
    assert np.abs(lighting.departures.mean(axis=0)).max() < 1e-9


def test_planted_exposures_and_tints_are_recovered() -> None:
    planted = PlantedLight(exposures=0.25, tints=0.1).gains(14, seed=3)
    planted /= planted.max()  # nothing is clipped
    exposures = light(planted).exposures - light(np.ones((14, 3))).exposures
    log = np.log(planted)
    # 8-bit values of about 80 levels are rounded by 0.3 levels rms, 0.4 %; with some hundred points, far less is left.
    assert np.abs(exposures - (log - log.mean(axis=0))).max() < 0.03


@pytest.mark.parametrize("photos", [36, 2 * TOGETHER + 1])
def test_light_that_follows_the_camera_is_left_in_and_a_jump_is_taken_out(photos: int) -> None:
    turns = 2 * np.pi * np.arange(photos) / photos
    smooth = np.repeat(0.25 * np.cos(turns)[:, None], 3, axis=1)
    drifting = on_a_ring(photos, smooth)
    assert drifting.spread > 0.15
    assert drifting.tail < 0.02
    jump = smooth.copy()
    jump[17] += 0.3
    departing = on_a_ring(photos, jump)
    assert int(np.abs(departing.departures).max(axis=1).argmax()) == 17
    assert departing.departures[17].mean() == pytest.approx(0.3, abs=0.04)


def test_many_photos_are_divided_into_parts_that_lie_apart() -> None:
    places = np.random.default_rng(0).normal(size=(2 * TOGETHER + 1, 3)) * (9.0, 1.0, 1.0)
    parts = divided(places)
    assert sorted(np.concatenate(parts)) == list(range(len(places)))
    assert sorted(map(len, parts)) == [250, 251, 500]
    along = sorted((places[part, 0].min(), places[part, 0].max()) for part in parts)
    assert all(before[1] <= after[0] for before, after in pairwise(along))
    assert len(divided(places[:TOGETHER])) == 1


def test_what_photos_tell_of_one_another_falls_with_their_distance() -> None:
    """By a simulation of the same light: what the best linear prediction from all other photos leaves."""
    assert on_a_ring(36, np.zeros((36, 3))).unseen < 0.02
    assert on_a_ring(4, np.zeros((4, 3))).unseen > 0.95
    lighting = on_a_ring(12, np.zeros((12, 3)))
    rng = np.random.default_rng(0)
    turns = 2 * np.pi * np.arange(12) / 12
    # Places and directions lie on the same circle, so that squared distances count twice.
    apart = 2 * (2 - 2 * np.cos(turns[:, None] - turns[None]))
    smooth = np.exp(-0.5 * apart / 0.5**2) + 1e-9 * np.eye(12)
    values = rng.multivariate_normal(np.zeros(12), smooth, size=20_000) + 5.0
    others = np.delete(values, 0, axis=1) + 0.1 * rng.standard_normal((20_000, 11))
    rest = others - others.mean(axis=1, keepdims=True)
    target = values[:, 0] - others.mean(axis=1)
    left = target - rest @ np.linalg.lstsq(rest, target, rcond=None)[0]
    assert lighting.unseen == pytest.approx(left.var(), rel=0.05)


def test_exposures_drawn_apart_are_taken_out_whole() -> None:
    drawn = np.repeat(0.3 * np.random.default_rng(1).standard_normal(36)[:, None], 3, axis=1)
    lighting = on_a_ring(36, drawn)
    departures = drawn - drawn.mean(axis=0)
    # Each photo is predicted by the mean of the 35 others; 60 values of 8 bits leave far less than a percent.
    assert np.abs(lighting.departures - departures * 36 / 35).max() < 0.01
    assert lighting.tail > 0.3


def test_a_photo_that_shows_too_little_keeps_its_light() -> None:
    world, views = lit(np.ones((14, 3)))
    assert world.point_views is not None
    offsets, track = world.point_views
    kept = np.flatnonzero(track != 5)
    counts = [int((track[a:b] != 5).sum()) for a, b in pairwise(offsets)]
    scene = Scene(**{**vars(world), "point_views": PointViews(np.cumsum([0, *counts]), track[kept])})
    lighting = light_of(scene, views)
    assert np.isinf(lighting.errors[5])
    assert (lighting.departures[5] == 0).all()
    assert np.isfinite(lighting.tail)


def test_without_tracks_light_cannot_be_compared() -> None:
    assert measure(still_life.scene(), still_life.training_views(), 0, None)[0].light is None


def test_a_photo_is_brought_to_other_light_and_clipped_values_count_no_more() -> None:
    (view, *_) = still_life.training_views()
    rgb = torch.full_like(view.full.rgb, 120)
    rgb[0, 0] = 255
    view.full.rgb.copy_(rgb)
    darker = view.relit(np.array([0.4, 0.2, 0.0]))
    assert darker.full.rgb[1, 1].tolist() == [80, 98, 120]
    assert darker.full.mask is not None
    assert (~darker.full.mask).nonzero().tolist() == [[0, 0]]
    assert view.full.rgb[1, 1].tolist() == [120, 120, 120]
    brighter = view.relit(np.array([-1.0, 0.0, 0.0]))
    assert brighter.full.rgb[1, 1].tolist() == [255, 120, 120]
    assert brighter.full.mask is None
    assert brighter.reduced(2).rgb.shape[0] == view.full.rgb.shape[0] // 2
