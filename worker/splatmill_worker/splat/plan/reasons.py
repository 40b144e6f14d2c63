"""The sentences that explain a plan, collected while the plan is made."""

from __future__ import annotations

from dataclasses import dataclass, field

from splatmill.schema import Switch

BY_OPTION = "Set by an option."


@dataclass
class Reasons:
    """The explanation of a plan. Each sentence states the fact, with its number, and what follows from it.

    chosen: a sentence for each field of the plan.
    left_out: a sentence for each thing that this scene does not need.
    forced: names of what an option fixed.
    """

    chosen: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    forced: list[str] = field(default_factory=list)

    def option(self, name: str) -> None:
        """Note that an option fixed the field `name`."""
        self.chosen[name] = BY_OPTION
        self.forced.append(name)

    def switch(self, name: str, asked: Switch, needed: bool, because: str) -> bool:
        """Whether `name` is on: as `asked`, or as `needed` where that is auto, for which `because` is the sentence."""
        on = needed if asked is Switch.auto else asked is Switch.on
        if asked is not Switch.auto:
            self.forced.append(name)
            because = BY_OPTION
        (self.chosen if on else self.left_out)[name] = because
        return on
