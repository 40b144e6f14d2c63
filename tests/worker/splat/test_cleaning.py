"""Proves that what is planted into a trained still life is found and named, and that what photos support stays.

Does not prove the evidence (test_evidence.py), nor how real models gain or lose (worker/bench/train.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import islice

import pytest
import torch

from splatmill_worker.splat.cleaning import MOST_LOST, Cleaning, Reason, clean, photo_psnr
from splatmill_worker.splat.engine.open import gaussians_of
from splatmill_worker.splat.evidence import evidence_of
from splatmill_worker.splat.gaussians import SH_C0, Gaussians, concatenate
from splatmill_worker.splat.render import render
from splatmill_worker.splat.train.loop import train
from splatmill_worker.splat.views import Target, TrainingView
from tests.support.training import first_engine, plan, split

BLACK = torch.zeros(3)
KINDS: tuple[Reason, ...] = ("giant", "island", "floater", "needle")
EACH = 3
"""Gaussians planted of a kind."""


def planted(kind: Reason, views: list[TrainingView]) -> Gaussians:
    """A Gaussian of a kind in pure magenta, which the still life does not have, where each of the views looks."""
    rows = []
    for view in views:
        camera = view.full.camera
        ahead = torch.from_numpy(camera.to_world(torch.tensor([[0.05, -0.05, 1.0]]).numpy())[0]).float()
        toward = ahead - torch.from_numpy(camera.center).float()
        center = torch.from_numpy(camera.center).float()
        depth, scales, opacity = {
            "giant": (0.6, (-1.2, -1.2, -1.2), 0.5),
            "needle": (0.8, (-2.0, -6.0, -6.0), 0.9),
            "island": (0.8, (-5.0, -5.0, -5.0), 0.9),
            "floater": (0.25, (-4.0, -4.0, -4.0), 0.7),
        }[kind]
        rows.append(
            Gaussians(
                (center + depth * toward)[None],
                torch.tensor([scales]),
                torch.tensor([[1.0, 0.2, 0.1, 0.0]]),
                torch.tensor([math.log(opacity / (1.0 - opacity))]),
                torch.tensor([[[0.5, -0.5, 0.5]]]) / SH_C0,
            )
        )
    return concatenate(*rows)


@dataclass(frozen=True)
class Trained:
    """A still life trained for a moment, its training views and its held-out ones."""

    gaussians: Gaussians
    training: list[TrainingView]
    held_out: list[TrainingView]

    def psnr(self, gaussians: Gaussians) -> float:
        """Mean over the held-out photos, dB."""
        return sum(photo_psnr(gaussians, view.full, BLACK) for view in self.held_out) / len(self.held_out)

    def cleaned(self, gaussians: Gaussians) -> Cleaning:
        return clean(gaussians, self.photos, BLACK)

    @property
    def photos(self) -> list[Target]:
        """The training photos."""
        return [view.full for view in self.training]


@pytest.fixture(scope="module")
def life() -> Trained:
    training, held_out = split()
    engine = first_engine()
    train(engine, training, held_out, plan(500), extent=1.1)
    return Trained(gaussians_of(engine).padded(1), training, held_out)


@pytest.mark.slow
def test_what_is_planted_goes(life: Trained) -> None:
    """One of the first kind, two of the second, and so on, where different views look: each goes, under its name."""
    spoilt, views = life.gaussians, iter(life.training)
    for number, kind in enumerate(KINDS, 1):
        looking = list(islice(views, number))
        spoilt = concatenate(spoilt, planted(kind, looking).padded(1))
        for photo in (view.full for view in looking):
            assert photo_psnr(spoilt, photo, BLACK) < photo_psnr(life.gaussians, photo, BLACK) - 0.05
    cleaning = life.cleaned(spoilt)
    gone = ~cleaning.keep
    assert bool(gone[life.gaussians.count :].all())
    for number, kind in enumerate(KINDS, 1):
        assert cleaning.removed[kind] >= number
    assert sum(cleaning.removed.values()) == int(gone.sum())
    # Held-out photos took no part in it, and are shown as without what was planted, or better.
    assert life.psnr(spoilt.select(cleaning.keep)) >= life.psnr(life.gaussians) - 0.02
    assert cleaning.psnr > cleaning.psnr_before


@pytest.mark.slow
def test_what_photos_support_stays(life: Trained) -> None:
    """Of the Gaussians that training left, those that go are ones that the photos are better without.

    Held-out photos decide nothing, and may lose a little.
    """
    cleaning = life.cleaned(life.gaussians)
    gone = ~cleaning.keep
    assert cleaning.psnr >= cleaning.psnr_before
    assert life.psnr(life.gaussians.select(cleaning.keep)) >= life.psnr(life.gaussians) - 0.05
    evidence = evidence_of(life.gaussians, life.photos, BLACK)
    heavy = evidence.support > 0.1 * evidence.support.max()
    assert int(heavy.sum()) > 10
    assert not bool((gone & heavy).any())
    assert bool((evidence.weight[gone] > 0).all())  # what no photo shows is no matter of support


@pytest.mark.slow
def test_what_one_photo_needs_stays_and_the_others_go(life: Trained) -> None:
    """A Gaussian that spoils all photos but one, where it is what passed by, beside some that spoil all of them."""
    spoilt = concatenate(life.gaussians, planted("giant", life.training[:1]).padded(1))
    assert not bool(life.cleaned(spoilt).keep[-1])
    shown = render(spoilt, life.photos[0].camera, background=BLACK).color.clamp(0.0, 1.0)
    passed = life.photos[0]._replace(rgb=(255.0 * shown.detach() + 0.5).to(torch.uint8))
    photos = [passed, *life.photos[1:]]
    kinds: tuple[Reason, ...] = ("needle", "floater", "island")
    harmful = [
        planted(kind, life.training[1 + EACH * number :][:EACH]).padded(1)
        for number, kind in enumerate(kinds)
    ]
    spoilt = concatenate(*harmful, spoilt)
    cleaning = clean(spoilt, photos, BLACK)
    assert bool(cleaning.keep[-1])
    assert not bool(cleaning.keep[: EACH * len(kinds)].any())
    left = spoilt.select(cleaning.keep)
    for photo in photos:
        assert photo_psnr(left, photo, BLACK) >= photo_psnr(spoilt, photo, BLACK) - MOST_LOST - 1e-3


def test_a_model_of_harmful_gaussians_alone_loses_all_of_them() -> None:
    training, _ = split()
    black = [view.full._replace(rgb=torch.zeros_like(view.full.rgb)) for view in training]
    harmful = planted("giant", training[-EACH:]).padded(1)
    cleaning = clean(harmful, black, BLACK)
    assert not bool(cleaning.keep.any())
    assert sum(cleaning.removed.values()) == cleaning.unsupported == EACH
    nothing = clean(harmful.select(torch.zeros(0, dtype=torch.int64)), black, BLACK)
    assert nothing.keep.shape == (0,)
    assert not any(nothing.removed.values())


@pytest.mark.slow
def test_the_same_model_and_photos_give_the_same_result(life: Trained) -> None:
    spoilt = concatenate(life.gaussians, planted("giant", life.training[-EACH:]).padded(1))
    one, other = (life.cleaned(spoilt).keep for _ in range(2))
    assert not bool(one[-EACH:].any())
    assert torch.equal(one, other)
