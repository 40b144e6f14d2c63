"""The lines that show a plan: each decision, with the fact that decided it."""

from collections.abc import Iterator, Mapping
from typing import Any

_NOT_DECISIONS = ("reasons", "left_out", "forced")


def plan_lines(plan: Mapping[str, Any]) -> Iterator[str]:
    """Yield one line per decision with its reason, then one per part that was left out.

    `plan` is the plan of a job or a report: values by name, and `reasons` and `left_out`, which map names to
    sentences.
    """
    reasons: Mapping[str, str] = plan.get("reasons") or {}
    for name, value in plan.items():
        if name in _NOT_DECISIONS or (isinstance(value, Mapping) and name not in reasons):
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
