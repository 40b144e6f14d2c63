"""Decisions with the sentences that explain them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Generic, NamedTuple, TypeVar

from splatmill.schema import Switch

BY_OPTION = "Set by an option."

T = TypeVar("T")


class Decision(NamedTuple, Generic[T]):
    """A field of the plan, or a thing that this scene does or does not need.

    value: what was decided; None or False for what is left out.
    reason: a sentence that states the fact, with its number, and what follows from it; empty where there is none.
    forced: whether an option fixed it.
    """

    value: T
    reason: str
    forced: bool = False


def by_option(value: T) -> Decision[T]:
    """The decision that an option makes."""
    return Decision(value, BY_OPTION, forced=True)


def switch(asked: Switch, needed: Decision[bool]) -> Decision[bool]:
    """What an option asks for, or what is needed where that is auto."""
    return needed if asked is Switch.auto else by_option(asked is Switch.on)


class Explanation(NamedTuple):
    """The reasons of a plan.

    chosen: a sentence for each field of the plan.
    left_out: a sentence for each thing that this scene does not need.
    forced: names of what an option fixed.
    """

    chosen: dict[str, str]
    left_out: dict[str, str]
    forced: tuple[str, ...]

    @staticmethod
    def of(by_name: Mapping[str, Decision[Any]]) -> Explanation:
        """The reasons of decisions."""
        explained = {name: each for name, each in by_name.items() if each.reason}
        absent = {name for name, each in explained.items() if each.value is None or each.value is False}
        return Explanation(
            {name: each.reason for name, each in explained.items() if name not in absent},
            {name: each.reason for name, each in explained.items() if name in absent},
            tuple(name for name, each in explained.items() if each.forced),
        )
