"""Options of the command line made from the schema: same names, ranges and help."""

import inspect
from collections.abc import Callable
from typing import Any, Literal

import typer

from splatmill.schema.base import Request
from splatmill.schema.options import OptionHelp, TrainOptions, describe_options

PANELS = {
    "budget": "How long, how good",
    "photos": "Photos",
    "cameras": "Recovering the cameras",
    "engine": "Engine",
}
_TYPES: dict[str, Any] = {
    "integer": int,
    "number": float,
    "text": str,
    "duration": str,
    "bytes": str,
    "list": list[str],
    "flag": bool,
}


def with_training_options(function: Callable[..., None]) -> Callable[..., None]:
    """Replace the `**options` of a command by one option per training setting."""
    return with_options_of(TrainOptions, function)


def with_options_of(model: type[Request], function: Callable[..., None]) -> Callable[..., None]:
    """Replace the `**options` of a command by one option per field of `model`.

    All are None where they are not given, so that only what a person said is sent and the server's own defaults
    hold for the rest.
    """
    signature = inspect.signature(function, eval_str=True)
    fixed = [p for p in signature.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
    made = [_parameter(option) for option in describe_options(model)]
    # typer reads the signature; there is no other place where it takes parameters that are not written out.
    function.__signature__ = signature.replace(parameters=[*fixed, *made])  # type: ignore[attr-defined]
    return function


def _parameter(option: OptionHelp) -> inspect.Parameter:
    kind: Any = Literal[tuple(option.choices)] if option.choices else _TYPES[option.type]
    settings: dict[str, Any] = {"rich_help_panel": PANELS[option.group], "show_default": False}
    if option.type in ("integer", "number"):
        settings |= {"min": option.minimum, "max": option.maximum}
    if option.type in ("duration", "bytes"):
        settings["metavar"] = option.type.upper()
    decided = option.default is None or option.default is False
    default = "" if decided else f" (default: {option.default})"
    return inspect.Parameter(
        option.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=typer.Option(None, option.flag, help=option.help + default, **settings),
        annotation=kind | None,
    )
