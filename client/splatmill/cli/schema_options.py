"""Options of the command line, generated from the schema: same names, ranges and help."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from splatmill.schema.base import Request
from splatmill.schema.options import OptionHelp, TrainOptions, describe_options

Photos = Annotated[
    Path,
    typer.Argument(
        metavar="PATH", help="Folder of photos, zip archive, video, or posed data set.", show_default=False
    ),
]
"""The argument of commands that train."""

PANELS = {
    "budget": "Length and size of the training",
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
    """Replace the `**options` of a command by one command-line option per training option."""
    return with_options_of(TrainOptions, function)


def with_options_of(model: type[Request], function: Callable[..., None]) -> Callable[..., None]:
    """Replace the `**options` of a command by one command-line option per field of `model`.

    An option that is not given is None, so that it is not sent and the default of the server applies.
    """
    signature = inspect.signature(function, eval_str=True)
    fixed = [p for p in signature.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
    made = [_parameter(option) for option in describe_options(model)]
    # typer reads the parameters from the signature, and has no other interface for parameters made at run time.
    function.__signature__ = signature.replace(parameters=[*fixed, *made])  # type: ignore[attr-defined]  # functions have no declared __signature__
    return function


def _parameter(option: OptionHelp) -> inspect.Parameter:
    kind: Any = Literal[tuple(option.choices)] if option.choices else _TYPES[option.type]
    settings: dict[str, Any] = {"rich_help_panel": PANELS[option.group], "show_default": False}
    if option.type in ("integer", "number"):
        settings |= {"min": option.minimum, "max": option.maximum}
    if option.type in ("duration", "bytes"):
        settings["metavar"] = option.type.upper()
    unsaid = option.default is None or option.default is False
    default = "" if unsaid else f" (default: {option.default})"
    return inspect.Parameter(
        option.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=typer.Option(None, option.flag, help=option.help + default, **settings),
        annotation=kind | None,
    )
