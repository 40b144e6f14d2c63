"""Proves when a plan measures LPIPS, and what it says where it does not. Does not prove the measure itself."""

from __future__ import annotations

from splatmill_worker.splat.plan.scores import MOST_FOR_LPIPS
from tests.support.plans.facts import changed, planned


def test_lpips_is_measured_where_it_can_be() -> None:
    plan = planned(changed())
    assert plan.lpips
    assert plan.reasons["lpips"].endswith("measured on 7 held-out photos at the end.")
    many = changed(held_out=MOST_FOR_LPIPS + 1)
    assert planned(changed(held_out=MOST_FOR_LPIPS)).lpips
    assert not planned(many).lpips
    assert "65 are held out" in planned(many).left_out["lpips"]
    assert planned(many, lpips="on").lpips


def test_lpips_is_left_out_with_its_reason() -> None:
    missing = planned(changed(no_lpips="The weights are not installed."))
    assert (missing.lpips, missing.left_out["lpips"]) == (False, "The weights are not installed.")
    assert "there are none" in planned(changed(held_out=0)).left_out["lpips"]
    assert "time is limited" in planned(changed(), time_budget=10).left_out["lpips"]
    assert planned(changed(), time_budget=10, lpips="on").lpips
    off = planned(changed(), lpips="off")
    assert (off.lpips, off.left_out["lpips"]) == (False, "Set by an option.")
    assert not planned(changed(held_out=0), lpips="on").lpips
