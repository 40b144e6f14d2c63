"""Pairs of training options that exclude each other by their values, whatever the photos and the machine are.

Every client and the server refuse such a pair when the options are checked, which is before anything is sent. What
photos or machines exclude besides, the worker refuses once it knows them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from splatmill.schema.files.formats import is_model_file, is_point_file, is_start_file

CONFLICT = "conflict"
"""Type of the error of a pair of options that exclude each other. Both options have one, with the same text."""


@dataclass(frozen=True)
class Conflict:
    """Two options that exclude each other.

    names: of the two options.
    excluded: whether a value of the first excludes one of the second.
    reason: why, and what to change: a sentence that names both.
    """

    names: tuple[str, str]
    excluded: Callable[[Any, Any], bool]
    reason: str


def _is_model(start: str | None) -> bool:
    """Whether a training surely starts from a model: a .ply may hold points."""
    if start is None or is_point_file(start):
        return False
    if not is_start_file(start):
        return True  # the id of a model
    return is_model_file(start) and (
        not start.lower().endswith(".ply") or start.lower().endswith(".compressed.ply")
    )


def _in_one_piece(name: str, is_given: Callable[[Any], bool]) -> Conflict:
    """The conflict of an option with tiles."""
    return Conflict(
        ("tiles", name),
        lambda tiles, value: tiles is not None and is_given(value),
        f"The option {name} is for a training in one piece: tiles are trained by several workers, each to the end of "
        f"its steps. Leave out {name} (preset and steps say how long each part is trained), or tiles.",
    )


CONFLICTS = (
    Conflict(
        ("pose_refinement", "backend"),
        lambda refinement, backend: refinement == "on" and backend == "gpu",
        "The backend gpu cannot refine cameras: set pose_refinement to auto, or backend to cpu.",
    ),
    Conflict(
        ("cluster_culling", "backend"),
        lambda culling, backend: culling == "on" and backend in ("gpu", "reference"),
        "Only the backend cpu can leave parts of a scene out of steps: set cluster_culling to auto, or backend to cpu.",
    ),
    Conflict(
        ("far_shell", "start"),
        lambda shell, start: shell == "on" and _is_model(start),
        "A far shell is added to points, and start names a model: set far_shell to auto, or leave start out.",
    ),
    Conflict(
        ("gaps", "start"),
        lambda gaps, start: gaps == "on" and _is_model(start),
        "Gaps between points are filled, and start names a model: set gaps to auto, or leave start out.",
    ),
    _in_one_piece("time_budget", lambda budget: budget is not None),
    _in_one_piece("within", lambda within: within is not None),
    _in_one_piece("start", lambda start: start is not None),
    _in_one_piece("progress_video", lambda video: video != "off"),
    _in_one_piece("time_lapse", lambda lapse: lapse == "on"),
)
"""All pairs of training options that exclude each other."""


def check_conflicts(options: Mapping[str, Any]) -> None:
    """Raise ValidationError where two of these options exclude each other, with an error for each of the two."""
    errors = [
        InitErrorDetails(
            type=PydanticCustomError(CONFLICT, conflict.reason), loc=(name,), input=str(options[name])
        )
        for conflict in CONFLICTS
        if conflict.excluded(*(options[name] for name in conflict.names))
        for name in conflict.names
    ]
    if errors:
        raise ValidationError.from_exception_data("TrainOptions", errors)
