"""Proves which pairs of photos are chosen by GPS, by names and by preemptive matches, and the view graph's components.

Does not prove that the pairs chosen on a real capture suffice; `test_reconstruct` and `bench sfm` register real photos.
"""

import numpy as np
import pytest

from splatmill_worker.sfm.matching import pairs
from tests.support.scenes.photos import usable


def test_gps_neighbours_are_the_nearest_ones() -> None:
    # A walk along a meridian, 11 metres a step, across the date line's other side for good measure.
    photos = [usable(str(k), latitude=10.0 + 1e-4 * k, longitude=180.0 - 1e-9) for k in range(6)]
    photos.append(usable("nowhere"))
    places = pairs.gps_positions(photos)
    assert np.linalg.norm(places[1] - places[0]) == pytest.approx(11.1, rel=0.01)
    assert np.isnan(places[6, :2]).all()
    two = pairs.spatial(places, 2)
    assert {(k, k + 1) for k in range(5)} <= two
    # Only the ends reach further than their neighbours.
    assert two - {(k, k + 1) for k in range(5)} == {(0, 2), (3, 5)}
    assert all(index != 6 for pair in pairs.spatial(places, 3) for index in pair)


@pytest.mark.parametrize(("latitude", "longitude"), [(0.0, 1e-4), (1e-4, 0.0)])
def test_the_equator_and_the_prime_meridian_are_places(latitude: float, longitude: float) -> None:
    photos = [usable("a", latitude=latitude, longitude=longitude), usable("b", latitude=1e-4, longitude=1e-4)]
    places = pairs.gps_positions(photos)
    assert np.linalg.norm(places[1] - places[0]) == pytest.approx(11.1, rel=0.01)
    assert pairs.spatial(places, 1) == {(0, 1)}


def test_numbered_photos_are_followed_in_order() -> None:
    names = [f"walk/IMG_{k}.jpg" for k in (10, 9, 8, 11, 12)] + ["other.jpg", "IMG_1.jpg"]
    assert pairs.numbered_runs([usable(name) for name in names]) == [[2, 1, 0, 3, 4]]
    assert pairs.sequential([2, 1, 0, 3, 4], (1,)) == {(1, 2), (0, 1), (0, 3), (3, 4)}


def test_components_of_the_view_graph_are_connected_by_the_pairs_with_the_most_matches() -> None:
    components = pairs.connected_components(6, [(0, 1), (1, 2), (3, 4)])
    assert components == [[0, 1, 2], [3, 4], [5]]
    more = pairs.connecting_pairs(components, {(2, 3): 9, (0, 4): 5, (1, 5): 3}, {(0, 3)}, per_photo=1)
    assert more == {(2, 3), (0, 4), (1, 5)}


def test_pairs_with_the_most_matches_come_first() -> None:
    scores = {(0, 1): 5, (0, 2): 9, (1, 2): 30, (0, 3): 7}
    assert pairs.best_pairs_of([0], scores, 4, 2) == {(0, 2), (0, 3)}
    assert pairs.best_pairs_of([0, 1], scores, 4, 1) == {(0, 2), (1, 2)}
    assert pairs.best_pairs_of([], scores, 4, 2) == set()
