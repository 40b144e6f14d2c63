"""What the service reports about itself: version, limits, workers, health."""

from typing import Any, Literal

from pydantic import Field

from splatmill.schema.base import Response, Time


class WorkerInfo(Response):
    """A worker that is registered with the job queue."""

    name: str = Field(description="Its machine and process, for an admin; for others, a number.")
    queues: list[str] = Field(default_factory=list, description="The queues that it serves: any, cpu, gpu.")
    state: str = Field(description="idle, busy, suspended, ...")
    job: str | None = Field(default=None, description="Id of the job it works on.")
    last_heartbeat: Time | None = None


class QueueInfo(Response):
    """A queue: the jobs that ask the same of their worker, by their option `backend`."""

    waiting: int = Field(ge=0, description="Number of jobs that wait.")
    workers: int = Field(ge=0, description="Number of workers that serve it.")


class Limits(Response):
    """Upper limits of what the service accepts."""

    max_file_bytes: int = Field(description="Size of one uploaded file, in bytes.")
    max_files_per_capture: int = Field(description="Number of files in a capture.")
    max_image_pixels: int = Field(
        description="Pixels of a photo; larger photos are left out of the training."
    )
    max_render_pixels: int = Field(description="Pixels of a rendered image.")


class Unread(Response):
    """A kind of files with photos, videos or archives that is not read."""

    what: str
    suffixes: list[str]
    advice: str = Field(description="What to do, as a sentence.")


class Accepted(Response):
    """Which files count as what, by the suffix of their name in lower case, and the least size of a photo."""

    photos: list[str]
    videos: list[str]
    archives: list[str]
    masks: list[str]
    mask_folders: list[str] = Field(
        description="Folders that hold masks, at any depth. Case does not matter, here and below."
    )
    mask_endings: list[str] = Field(
        default_factory=list,
        description="What follows the name of a photo, with or without its suffix, in that of a mask.",
    )
    mask_beginnings: list[str] = Field(
        default_factory=list, description="What precedes the name of a photo in that of a mask."
    )
    other_folders: dict[str, list[str]] = Field(
        default_factory=dict,
        description="What lies in folders that hold no photos, with the names, in lower case, of these.",
    )
    unused_folders: list[str] = Field(
        default_factory=list,
        description="Those of `other_folders` of which no use is made where photos lie beside them.",
    )
    depth_folders: list[str] = Field(
        default_factory=list,
        description="Those of `other_folders` whose pictures are uploaded as poses: depths of the photos, and how "
        "sure they are.",
    )
    output_marks: list[str] = Field(
        default_factory=list,
        description="Names of files of which a folder with results of Splatmill holds two at least.",
    )
    output_media: list[str] = Field(
        default_factory=list, description="Names of files in such a folder that are not read."
    )
    unread: list[Unread] = Field(default_factory=list, description="Kinds of files that are not read.")
    program_files: list[str] = Field(
        default_factory=list,
        description="Patterns of the names, in lower case, of files in which other programs may have written cameras.",
    )
    camera_lists: list[str] = Field(
        default_factory=list,
        description="Patterns of the names, in lower case, of lists that belong to files `*.out` of cameras.",
    )
    large_cameras: list[str] = Field(
        default_factory=list, description="Patterns of `other_cameras` whose files are not uploaded."
    )
    other_cameras: dict[str, list[str]] = Field(
        default_factory=dict,
        description="Programs whose cameras are not read, with patterns of the names, in lower case, of their files.",
    )
    points: list[str] = Field(
        default_factory=list,
        description="Suffixes of files of points that a training may start from, with the option `start`.",
    )
    example: str | None = Field(
        default=None,
        description="Name of a file of any content among the images. Where it is the only file of a capture, a worker "
        "makes photos of a built-in still life in its place.",
    )
    min_photos: int = Field(description="Photos without cameras that a job needs at least.")
    min_photo_side: int = Field(
        description="Pixels; photos with a shorter side are left out of the training."
    )


class Lan(Response):
    """How devices of the local network reach the server."""

    url: str = Field(description="Address of the server in the network.")
    fingerprint: str = Field(
        description="SHA-256 of the certificate, which the server has signed itself, as browsers show it."
    )


class LanAccess(Lan):
    """How devices of the local network reach and use the server: the response of `/v1/lan`."""

    key: str | None = Field(
        description="The key that all of them may use; null where the server has stored keys alone."
    )


class Info(Response):
    """The response of `/v1/info`."""

    name: Literal["splatmill"] = "splatmill"
    version: str
    api: str = "v1"
    storage: str = Field(description="Kind of storage: file or s3.")
    workers: list[WorkerInfo] = Field(default_factory=list)
    queued: int = Field(default=0, ge=0, description="Number of jobs that wait for a worker.")
    queues: dict[str, QueueInfo] = Field(
        default_factory=dict,
        description="The queues: any (backend auto), cpu (backends cpu and reference) and gpu (backend gpu).",
    )
    limits: Limits
    accepted: Accepted | None = Field(
        default=None, description="Files that a capture may hold; null on servers before this was told."
    )
    local: bool | None = Field(
        default=None,
        description="Whether the server listens where only its own machine reaches it; a proxy may lead to it all the "
        "same. Null on servers before this was told.",
    )
    lan: Lan | None = Field(
        default=None,
        description="The local network, where the server was started for it (`splatmill up --lan`).",
    )
    details: dict[str, Any] = Field(default_factory=dict)


class Health(Response):
    """The response of `/healthz`: the process runs."""

    status: Literal["ok"] = "ok"


class Ready(Response):
    """Whether the service can run jobs. Each check holds `ok` or a description of what is wrong."""

    ready: bool
    checks: dict[str, str] = Field(default_factory=dict)
