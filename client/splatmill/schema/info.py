"""What the service says of itself."""

from typing import Any, Literal

from pydantic import Field

from splatmill.schema.base import Response, Time

DEFAULT_PORT = 8080
"""Where a server listens, and where a client looks for one, unless told otherwise."""


class WorkerInfo(Response):
    """A worker that is registered with the queue."""

    name: str
    queues: list[str] = Field(default_factory=list)
    state: str = Field(description="idle, busy, suspended, ...")
    job: str | None = None
    last_heartbeat: Time | None = None


class Limits(Response):
    """What the service accepts at most."""

    max_file_bytes: int
    max_files_per_capture: int
    max_image_pixels: int
    max_render_pixels: int


class Info(Response):
    """What `/v1/info` answers."""

    name: Literal["splatmill"] = "splatmill"
    version: str
    api: str = "v1"
    storage: str = Field(description="The kind of storage: file, s3.")
    workers: list[WorkerInfo] = Field(default_factory=list)
    queued: int = Field(default=0, ge=0, description="Jobs that wait.")
    limits: Limits
    details: dict[str, Any] = Field(default_factory=dict)


class Health(Response):
    """The process answers."""

    status: Literal["ok"] = "ok"


class Ready(Response):
    """Whether the service can do its work; each part says `ok` or what is wrong with it."""

    ready: bool
    checks: dict[str, str] = Field(default_factory=dict)
