"""Inputs of the fuzz tests: what hypothesis draws, and for how long.

`SPLATMILL_FUZZ=200 python -m pytest tests/kernels -k fuzz --timeout 0` draws 200 times as many inputs as CI does, other
ones in every run; what fails is printed as a small input, with the decorator that draws it again.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TypeVar

import torch
from _studies.stability.extremes import FAMILIES, LENS, SPLAT, decided, several
from _studies.stability.scenes import Scene
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.support.kernels.cases import GROUPS, Case

TIMES = int(os.environ.get("SPLATMILL_FUZZ", "1"))

Test = TypeVar("Test", bound=Callable[..., None])


def inputs(number: int) -> Callable[[Test], Test]:
    """Draw that many inputs: the same ones in every run of CI, other ones in a long run."""
    once = TIMES == 1
    return settings(
        max_examples=number * TIMES,
        derandomize=once,
        database=None,
        deadline=None,
        print_blob=True,
        # A smaller input is worth its time only where somebody waits for it.
        phases=[Phase.explicit, Phase.generate] if once else list(Phase),
        suppress_health_check=list(HealthCheck),
    )


def units(count: int) -> st.SearchStrategy[list[float]]:
    """Numbers in [0, 1]; 0, 1, 1/2 and repeated ones more often than by chance."""
    return st.lists(st.floats(0, 1), min_size=count, max_size=count)


SIDES = (1, 15, 16, 17, 33)
"""Sides of images: of a pixel, about a tile, and of three tiles, the last one of a single column."""


@st.composite
def cases(draw: st.DrawFn, most: int = 4) -> Case:
    """Up to `most` extreme Gaussians before an extreme camera, with one of the contract's options or none."""
    twins = FAMILIES["twins"]
    count = draw(st.integers(0, most))
    scene = (
        twins.make(draw(units(twins.numbers)))
        if count == 0
        else several(count)(draw(units(LENS + SPLAT * count)))
    )
    return of_scene(
        scene,
        width=draw(st.sampled_from(SIDES)),
        height=draw(st.sampled_from(SIDES)),
        degree=draw(st.integers(0, 3)),
        antialias=draw(st.booleans()),
    )


def of_scene(scene: Scene, **changed: object) -> Case:
    """The case of a scene, with fields of `Case` replaced."""
    arrays = {name: getattr(scene, name).float() for name in (*GROUPS, "viewmat", "K")}
    return Case("fuzz", **{**arrays, "width": scene.width, "height": scene.height, **changed})


def sure(case: Case) -> bool:
    """Whether something is drawn, and rounding decides about no Gaussian as a whole."""
    arrays = {name: getattr(case, name).double() for name in (*GROUPS, "viewmat", "K")}
    return decided(Scene(**arrays, width=case.width, height=case.height))


def reordered(case: Case, order: Tensor) -> Case:
    """The case with its Gaussians in another order."""
    from dataclasses import replace

    return replace(case, **{name: getattr(case, name)[order] for name in GROUPS})


def same_bits(a: Tensor, b: Tensor) -> bool:
    """Whether two tensors have the same bytes; NaN equals itself."""
    return a.shape == b.shape and a.detach().numpy().tobytes() == b.detach().numpy().tobytes()


def rolled(count: int) -> Tensor:
    """An order in which no Gaussian keeps its place."""
    return torch.roll(torch.arange(count), 1)
