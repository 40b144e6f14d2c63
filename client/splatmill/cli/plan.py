"""The plan in lines: what was decided, and the fact that decided it."""

from collections.abc import Iterator, Mapping
from typing import Any

_ABOUT = ("reasons", "left_out", "forced")


def plan_lines(plan: Mapping[str, Any]) -> Iterator[str]:
    """One line per decision with its reason, then one per thing that was left out.

    `plan` is a plan as jobs and reports carry it: values by name, and beside them `reasons` and `left_out`, each a
    sentence by name.
    """
    reasons: Mapping[str, str] = plan.get("reasons") or {}
    for name, value in plan.items():
        if name in _ABOUT or (isinstance(value, Mapping) and name not in reasons):
            continue
        shown = "" if isinstance(value, Mapping) else f": {_value(value)}"
        reason = f" - {reasons[name]}" if name in reasons else ""
        yield f"{_words(name)}{shown}{reason}"
    for name, reason in reasons.items():
        if name not in plan:
            yield f"{_words(name)} - {reason}"
    for name, reason in (plan.get("left_out") or {}).items():
        yield f"without {_words(name)} - {reason}"


def _words(name: str) -> str:
    return name.replace("_", " ")


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
