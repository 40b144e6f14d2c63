"""One camera for each photo: files may name a photo several times, with the same camera or with different ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from splatmill_worker.scene import View
from splatmill_worker.sfm.posed.model_files import MOST_FAULTY

SAME_TURN = 1e-3
"""Largest element of the difference of two rotations that counts as rounding."""

SAME_PLACE = 1e-4
"""Distance of two cameras that counts as rounding, in radii of all cameras around their mean."""

SAME_LENS = 1e-3
"""Relative difference of two focal lengths, and of the other intrinsics over the longest side, that is rounding."""


def one_for_each(
    views: Mapping[int, View], where: Callable[[int], str]
) -> tuple[dict[int, View], tuple[tuple[str, str], ...]]:
    """The views, of which the first stands for those of the same photo with the same camera; and the photos that have
    different cameras, each with the reason why it is left out.

    where: says, as a part of a sentence, what has the view of a key.

    Raises ValueError, with both readings of the first, where such photos are more than MOST_FAULTY of all.
    """
    keys_of: dict[Path, list[int]] = {}
    for key, view in views.items():
        keys_of.setdefault(view.image, []).append(key)
    radius = _radius(views)
    kept: dict[int, View] = {}
    faults: list[tuple[str, str]] = []
    for first, *others in keys_of.values():
        view = views[first]
        other = next((key for key in others if not _same(view, views[key], radius)), None)
        if other is None:
            kept[first] = view
            continue
        here, there = (f"{where(key)} has it {_place(views[key])}" for key in (first, other))
        faults.append((view.name, f"it has two cameras: {here}, and {there}; remove the wrong one"))
    if len(faults) > MOST_FAULTY * len(keys_of):
        name, fault = faults[0]
        raise ValueError(
            f"Different cameras are given for {len(faults)} of {len(keys_of)} photos, such as {name}: {fault}."
        )
    return kept, tuple(faults)


def _radius(views: Mapping[int, View]) -> float:
    centers = np.array([view.camera.center for view in views.values()]).reshape(-1, 3)
    return float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()) if len(centers) else 0.0


def _same(one: View, other: View, radius: float) -> bool:
    a, b = one.camera, other.camera
    side = max(a.width, a.height)
    lens, other_lens = (() if each.lens is None else each.lens.params for each in (one, other))
    return bool(
        np.abs(a.viewmat[:3, :3] - b.viewmat[:3, :3]).max() <= SAME_TURN
        and np.linalg.norm(a.center - b.center) <= SAME_PLACE * radius
        and np.allclose((a.fx, a.fy), (b.fx, b.fy), rtol=SAME_LENS, atol=0.0)
        and np.allclose((a.cx, a.cy), (b.cx, b.cy), rtol=0.0, atol=SAME_LENS * side)
        and len(lens) == len(other_lens)
        and np.allclose(lens, other_lens, rtol=SAME_LENS, atol=SAME_LENS)
    )


def _place(view: View) -> str:
    """Place, direction and focal length of a camera, as a part of a sentence."""
    place, axis = (
        ", ".join(f"{value:.4g}" for value in row) for row in (view.camera.center, view.camera.axis)
    )
    return f"at ({place}), looking along ({axis}), with fx {view.camera.fx:.5g}"
