"""Converts the errors of pydantic into one problem, with the most specific code and all errors among its facts."""

import difflib
from collections.abc import Sequence
from typing import Any

from splatmill.schema import MAX_RENDER_PIXELS, MAX_RENDER_SIDE, Problem, TrainOptions
from splatmill.schema.conflicts import CONFLICT

_RANGE = {"greater_than", "greater_than_equal", "less_than", "less_than_equal", "enum", "literal_error"}
_RANGE |= {"too_short", "too_long", "finite_number", "multiple_of"}
_SIZES = {"width", "height"}
_LENS = {"camera", "camera_to_world", "convention", "fx", "fy", "cx", "cy", "fov_y_deg"}


def problem_of_validation(errors: Sequence[Any]) -> Problem:
    """Return the problem for a request that does not match the schema; `errors` are those of pydantic."""
    facts: dict[str, Any] = {"errors": [_fact(error) for error in errors[:20]]}
    if any(error["type"] == "json_invalid" for error in errors):
        where = errors[0]["loc"][-1]
        detail = (
            f"The body is not JSON: {errors[0].get('ctx', {}).get('error', 'it is incomplete')} (at {where})."
        )
        return Problem.of("malformed_body", detail, advice="Send one JSON object.", facts=facts)
    for error in errors:
        if (problem := _named(error)) is not None:
            code, detail, advice = problem
            return Problem.of(code, detail, advice=advice, facts=facts)
    shown = "; ".join(f"{_path(error)}: {error['msg']}" for error in errors[:3])
    return Problem.of("invalid_request", f"The request does not match the schema: {shown}.", facts=facts)


def _named(error: Any) -> tuple[str, str, str | None] | None:
    """Return code, detail and advice of an error with a specific code, or None."""
    loc = [str(part) for part in error["loc"] if part != "body"]
    field, kind, value = (loc[-1] if loc else ""), error["type"], error.get("input")
    if loc[:1] == ["options"] and len(loc) > 1:
        if kind == "extra_forbidden":
            near = difflib.get_close_matches(field, TrainOptions.model_fields, n=1)
            advice = f"Did you mean {near[0]!r}?" if near else None
            return (
                "unknown_option",
                f"There is no option {field!r}.",
                advice or "List the options with GET /v1/options.",
            )
        if kind == CONFLICT:
            return "option_out_of_range", _sentence(error), None
        if kind in _RANGE:
            detail = f"The option {loc[1]!r} cannot be {_short(value)}: {_sentence(error)}"
            return "option_out_of_range", detail, "List the accepted values with GET /v1/options."
        return None
    if field in _SIZES and kind != "missing":
        detail = f"The {field} of the image cannot be {_short(value)}: {_sentence(error)}"
        limits = (
            f"Give sides of 1 to {MAX_RENDER_SIDE} pixels, and at most {MAX_RENDER_PIXELS} pixels in all."
        )
        return "size_out_of_range", detail, limits
    if isinstance(value, dict) and kind == "value_error" and _pixels(value) > MAX_RENDER_PIXELS:
        return "size_out_of_range", _sentence(error), "Request a smaller image."
    if _LENS & set(loc):
        return "camera_invalid", f"The camera is not valid: {_sentence(error)}", None
    return None


def _pixels(camera: dict[Any, Any]) -> float:
    width, height = camera.get("width"), camera.get("height")
    return width * height if isinstance(width, int) and isinstance(height, int) else 0


def _path(error: Any) -> str:
    return ".".join(str(part) for part in error["loc"] if part != "body") or "body"


_WORDS = {
    "greater_than": "It must be more than {gt}.",
    "greater_than_equal": "It must be at least {ge}.",
    "less_than": "It must be less than {lt}.",
    "less_than_equal": "It must be at most {le}.",
    "enum": "It must be {expected}.",
    "literal_error": "It must be {expected}.",
    "int_parsing": "It must be a whole number.",
    "int_type": "It must be a whole number.",
    "float_parsing": "It must be a number.",
    "float_type": "It must be a number.",
}
"""What pydantic says of a value, in words that also fit beside a field of the page."""


def _sentence(error: Any) -> str:
    if (words := _WORDS.get(error["type"])) is not None:
        return words.format(**error.get("ctx", {}))
    text = str(error["msg"]).removeprefix("Value error, ").strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "?", "!")) else ".")


def _fact(error: Any) -> dict[str, Any]:
    return {"where": _path(error), "what": _sentence(error), "given": _short(error.get("input"))}


def _short(value: Any) -> str:
    try:
        text = repr(value)
    except RecursionError:
        return "a deeply nested value"
    return text if len(text) <= 80 else text[:77] + "..."
