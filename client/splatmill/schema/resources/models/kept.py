"""What the server makes of a model in the background and keeps with it: what orbit videos and meshes have in common."""

from collections.abc import Callable
from enum import StrEnum
from typing import Any

from pydantic import BaseModel, Field

from splatmill.schema.base import Response, Time
from splatmill.schema.problems import Problem


class KeptState(StrEnum):
    """Where something that is made in the background stands."""

    queued = "queued"
    running = "running"
    succeeded = "succeeded"
    failed = "failed"

    @property
    def final(self) -> bool:
        """Whether nothing follows this state, unless it is asked for again."""
        return self in (KeptState.succeeded, KeptState.failed)


class Kept(Response):
    """Something that is made of a model in the background, and kept with it."""

    id: str = Field(description="The same for the same request on the same model.")
    model: str
    state: KeptState
    created_at: Time
    finished_at: Time | None = None
    bytes: int | None = Field(default=None, ge=0, description="Size of the file; null until it is whole.")
    problem: Problem | None = Field(default=None, description="Why it failed.")
    links: dict[str, str] = Field(default_factory=dict, description="Related addresses.")


def known(kind: type[BaseModel]) -> Callable[[Any], Any]:
    """Return a validator that leaves out what a newer server added to a request, which the request would refuse."""

    def only(request: Any) -> Any:
        if not isinstance(request, dict):
            return request
        return {name: value for name, value in request.items() if name in kind.model_fields}

    return only
