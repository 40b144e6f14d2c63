"""The plan in lines: what was decided, and the fact that decided it."""

from collections.abc import Iterator, Mapping
from typing import Any


def plan_lines(plan: Mapping[str, Any]) -> Iterator[str]:
    """One line per decision, `name: value (reason)`; what was left out comes last, with its reason."""
    left_out = plan.get("left_out")
    for name, entry in plan.items():
        if name != "left_out" and entry is not None:
            yield f"{name.replace('_', ' ')}: {_decision(entry)}"
    if isinstance(left_out, Mapping):
        for name, reason in left_out.items():
            yield f"without {str(name).replace('_', ' ')}: {_decision(reason)}"
    elif isinstance(left_out, list):
        for entry in left_out:
            yield f"left out: {_decision(entry)}"


def _decision(entry: Any) -> str:
    if isinstance(entry, Mapping):
        reason = entry.get("reason") or entry.get("because")
        value = entry.get("value", entry.get("name"))
        if reason is not None and value is not None:
            return f"{_value(value)} ({reason})"
        if reason is not None:
            return str(reason)
    return _value(entry)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return " x ".join(_value(item) for item in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_value(item)}" for name, item in value.items())
    return str(value)
