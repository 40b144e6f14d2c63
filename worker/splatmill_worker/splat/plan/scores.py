"""The decision on what is measured at the end beside PSNR and SSIM."""

from __future__ import annotations

from splatmill.schema import Switch, TrainOptions
from splatmill_worker.splat.plan.facts import Facts
from splatmill_worker.splat.plan.reasons import Decision, switch

MOST_FOR_LPIPS = 64
"""Held-out photos up to which LPIPS is measured without being asked for, which takes a minute or two."""


def decide_lpips(facts: Facts, options: TrainOptions) -> Decision[bool]:
    """Whether LPIPS of the held-out photos is measured at the end."""
    if facts.no_lpips is not None:
        return Decision(False, facts.no_lpips)
    if not facts.held_out:
        return Decision(False, "LPIPS is measured on held-out photos, and there are none.")
    if options.lpips is Switch.auto and options.timed:
        return Decision(
            False, "LPIPS takes a second and more of each photo; where time is limited, lpips has to be on."
        )
    if options.lpips is Switch.auto and facts.held_out > MOST_FOR_LPIPS:
        return Decision(
            False,
            f"LPIPS takes a second and more of each photo, and {facts.held_out} are held out; on more than "
            f"{MOST_FOR_LPIPS}, lpips has to be on.",
        )
    because = (
        f"The weights of LPIPS are installed; it is measured on {facts.held_out} held-out photos at the end."
    )
    return switch(options.lpips, Decision(True, because))
