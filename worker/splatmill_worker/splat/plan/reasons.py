"""The sentences that a plan collects while it is made."""

from __future__ import annotations

from dataclasses import dataclass, field

from splatmill.schema import Switch


@dataclass
class Reasons:
    """`chosen` has one sentence per field of the plan, `left_out` one per thing that is not needed."""

    chosen: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    forced: list[str] = field(default_factory=list)

    def option(self, name: str) -> None:
        """The field is what an option says."""
        self.chosen[name] = "Set by option."
        self.forced.append(name)

    def switch(self, name: str, asked: Switch, needed: bool, because: str) -> bool:
        """Whether `name` is on: as asked, or where that is auto as `needed` says, for the reason `because`."""
        on = needed if asked is Switch.auto else asked is Switch.on
        if asked is not Switch.auto:
            self.forced.append(name)
            because = "Set by option."
        (self.chosen if on else self.left_out)[name] = because
        return on
