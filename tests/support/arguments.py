"""The text of `splatmill/sdk/arguments.py`, from the schema. `make generated` writes it."""

import json
import types
import typing
from enum import StrEnum
from typing import Any, Literal

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from splatmill.schema import ChangePresentation, MeshRequest, OrbitRequest, RenderRequest, TrainOptions
from splatmill.schema.base import Request
from tests.support.paths import ROOT

PATH = ROOT / "client" / "splatmill" / "sdk" / "arguments.py"

CLASSES: tuple[tuple[str, type[Request], str], ...] = (
    ("TrainArguments", TrainOptions, "The settings of a training: the fields of `TrainOptions`."),
    (
        "RenderArguments",
        RenderRequest,
        "How an image is rendered: the fields of `RenderRequest` but the camera.",
    ),
    ("OrbitArguments", OrbitRequest, "How a video is rendered: the fields of `OrbitRequest`."),
    ("MeshArguments", MeshRequest, "How a mesh is made: the fields of `MeshRequest`."),
    (
        "PresentationArguments",
        ChangePresentation,
        "How a model is shown to people: the fields of `Presentation`.",
    ),
)

WIDER = {"duration": "float | str", "bytes": "int | str"}
"""Types that are also accepted as text, by the field's kind."""

PATHS = {"start": "str | os.PathLike[str]"}
"""Arguments of the SDK that may be paths."""


def text() -> str:
    """The whole module."""
    names = sorted({name for _, model, _ in CLASSES for name in _names(model)})
    head = [
        '"""The keyword arguments of `train`, `render`, `orbit`, `mesh` and `present`, for editors and type checkers.',
        "",
        "Generated from the schema by `make generated`.",
        '"""',
        "",
        "import os",
        "from collections.abc import Mapping, Sequence",
        "from typing import Any, Literal, TypedDict",
        "",
        "from splatmill.schema import (",
        *(f"    {name}," for name in names),
        ")",
    ]
    return "\n".join([*head, *(line for entry in CLASSES for line in _class(*entry))]) + "\n"


def _class(name: str, model: type[Request], doc: str) -> list[str]:
    fields = {field: info for field, info in model.model_fields.items() if field != "camera"}
    lines = [f"    {field}: {_type(field, info)}" for field, info in fields.items()]
    return ["", "", f"class {name}(TypedDict, total=False):", f'    """{doc}"""', "", *lines]


def _members(annotation: Any) -> list[Any]:
    """The members of a union; an annotation that is none is its only member."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return [each for member in typing.get_args(annotation) for each in _members(member)]
    return [annotation]


def _names(model: type[Request]) -> list[str]:
    """The names that the types of a message's fields import from the schema."""
    fields = {name: info for name, info in model.model_fields.items() if name != "camera"}
    members = [kind for info in fields.values() for kind in _members(info.annotation)]
    kinds = [typing.get_args(kind)[0] if typing.get_origin(kind) is list else kind for kind in members]
    return [
        kind.__name__ for kind in kinds if isinstance(kind, type) and issubclass(kind, StrEnum | BaseModel)
    ]


def _type(name: str, info: FieldInfo) -> str:
    extra = info.json_schema_extra
    kind = extra.get("kind") if isinstance(extra, dict) else None
    members = _members(info.annotation)
    wider = PATHS.get(name) or (WIDER.get(kind) if isinstance(kind, str) else None)
    parts = [wider] if wider else [_one(member) for member in members if member is not types.NoneType]
    return " | ".join([*parts, "None"] if types.NoneType in members else parts)


def _one(kind: Any) -> str:
    if typing.get_origin(kind) is Literal:
        return f"Literal[{', '.join(map(json.dumps, typing.get_args(kind)))}]"
    if typing.get_origin(kind) is tuple:
        return "Sequence[str]"
    if typing.get_origin(kind) is list:
        return f"Sequence[{_one(typing.get_args(kind)[0])}]"
    if issubclass(kind, BaseModel):
        return f"{kind.__name__} | Mapping[str, Any]"
    if issubclass(kind, StrEnum):
        return f"{kind.__name__} | Literal[{', '.join(json.dumps(str(member)) for member in kind)}]"
    return str(kind.__name__)
