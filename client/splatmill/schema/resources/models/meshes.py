"""Meshes of a model that the server makes in the background and keeps with it."""

from enum import StrEnum
from typing import Annotated, Self

from pydantic import BeforeValidator, Field, model_validator

from splatmill.schema.base import Request, Response
from splatmill.schema.resources.jobs.events import Progress
from splatmill.schema.resources.models.edits import Box
from splatmill.schema.resources.models.kept import Kept, known


class MeshFormat(StrEnum):
    """File formats of meshes."""

    glb = "glb"
    ply = "ply"


class MeshRequest(Request):
    """A mesh of a model: the surfaces on which its cameras agree, with a colour at each vertex or with a texture."""

    format: MeshFormat = Field(default=MeshFormat.glb, description="File format.")
    faces: int = Field(default=500_000, ge=100, le=5_000_000, description="Most triangles.")
    voxel: float | None = Field(
        default=None,
        gt=0,
        le=1e9,
        description="Finest detail, in units of the model. Left out, the size of a pixel at the median depth.",
    )
    box: Box | None = Field(default=None, description="Only what lies in it is built.")
    texture: int | None = Field(
        default=None,
        ge=256,
        le=4096,
        description="Longest side of a texture in pixels, of a .glb. Left out, each vertex has a colour instead.",
    )

    @model_validator(mode="after")
    def _drawable(self) -> Self:
        if self.texture is not None and self.format is not MeshFormat.glb:
            raise ValueError(f"a .{self.format} has no texture: ask for a .glb, or leave out texture")
        return self


class MeshFacts(Response):
    """What a mesh is made of."""

    triangles: int = Field(ge=1)
    vertices: int = Field(ge=1)
    views: int = Field(ge=1, description="Number of cameras whose depths it was made from.")
    voxel: float = Field(gt=0, description="Finest detail, in units of the model.")


class Mesh(Kept):
    """A mesh of a model: what was asked for, and how far it is."""

    request: Annotated[MeshRequest, BeforeValidator(known(MeshRequest))]
    progress: Progress | None = Field(default=None, description="What is being done, while it is running.")
    facts: MeshFacts | None = Field(default=None, description="What it is made of; null until it is whole.")


class MeshList(Response):
    """The meshes of a model, newest first."""

    meshes: list[Mesh]
