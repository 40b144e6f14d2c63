"""The HTTP interface of the renderer process, on a port or a unix socket.

Requests and responses are those of the public API (`RenderRequest`, `OrbitRequest`, problem documents), so the server
only forwards them; for what it keeps, it asks in its own name. The renderer computes ETags and answers `If-None-Match`
itself.
"""

import builtins
import hashlib

from pydantic import BaseModel

from splatmill.schema import MeshFacts, Problem, Progress

HEALTH = "/healthz"
"""The path at which the renderer answers that it runs, and with its `RendererState`."""

CLIENT_HEADER = "Splatmill-Client"
"""Header of a request to the renderer: whose it is, as `client_of` writes it."""

IDLE_TIMEOUT = 130
"""Seconds after which the renderer and the API close a connection without requests.

Clients must close theirs first: a request on a connection that is just being closed fails. httpx does so after
5 seconds, nginx after 60 and Caddy after 120.
"""

REQUEST_HEADER = "X-Request-ID"
"""Header of a request to the renderer: the id of the client's request, for the log."""


class RendererState(BaseModel):
    """What the renderer says of itself.

    status: "ok"; None if it did not answer.
    admitted: number of requests that wait or are rendered.
    cached: bytes of the models in its memory.
    """

    status: str | None = None
    admitted: int = 0
    cached: int = 0


class MeshLine(BaseModel):
    """A line of JSON in the answer of the renderer while it makes a mesh; one field is set, or the last two are.

    progress: what it does. It comes again and again, so that silence means that the renderer has ended.
    problem: why there is no mesh; nothing follows.
    facts, bytes: what the mesh is made of, and the size of the file, which follows the line.
    """

    progress: Progress | None = None
    problem: Problem | None = None
    facts: MeshFacts | None = None
    bytes: int | None = None

    def encoded(self) -> "builtins.bytes":
        """The line with its end."""
        return self.model_dump_json(exclude_none=True).encode() + b"\n"


def client_of(owner: str, client: str) -> str:
    """Return the text of CLIENT_HEADER. Owners take turns, and the clients of one owner take turns among themselves.

    owner: whose request it is. client: what distinguishes it from other clients of this owner.
    """
    return "/".join(hashlib.sha256(text.encode()).hexdigest()[:16] for text in (owner, client))


def render_path(model_id: str) -> str:
    """Return the path to which a `RenderRequest` is posted; the response is the image."""
    return f"/v1/models/{model_id}/render"


def orbit_path(model_id: str) -> str:
    """Return the path to which an `OrbitRequest` is posted; the response is an MP4 video."""
    return f"/v1/models/{model_id}/orbit"


def orbit_frames_path(model_id: str) -> str:
    """Return the path to which an `OrbitFrames` is posted; the response is an MP4 video of these frames."""
    return f"/v1/models/{model_id}/orbit/frames"


def orbit_join_path(model_id: str) -> str:
    """Return the path to which a `JoinOrbit` is posted; the response is the MP4 video of all stored frames."""
    return f"/v1/models/{model_id}/orbit/join"


def convert_path(model_id: str) -> str:
    """Return the path to which a `ConversionRequest` is posted; the response is the file, with CONVERSION_HEADER."""
    return f"/v1/models/{model_id}/convert"


def edits_path(model_id: str) -> str:
    """Return the path to which an `EditModel` is posted; the response is the new model.ply, or for a preview empty.

    Its header EDIT_HEADER holds the `Edited`, as JSON.
    """
    return f"/v1/models/{model_id}/edits"


def mesh_path(model_id: str) -> str:
    """Return the path to which a `MeshRequest` is posted; the response is lines (`MeshLine`) and then the file."""
    return f"/v1/models/{model_id}/mesh"


def address(url: str) -> tuple[str, str | None]:
    """Return the base URL of the renderer and, for `unix:/path/to.sock`, the path of the socket.

    Raises ValueError unless `url` is `http://host:port`, `https://...` or `unix:/path`.
    """
    if url.startswith("unix:"):
        path = url.removeprefix("unix:").removeprefix("//")
        if path.startswith("/"):
            return "http://renderer", path
    elif url.startswith(("http://", "https://")):
        return url.rstrip("/"), None
    raise ValueError(
        f"SPLATMILL_RENDERER_URL={url!r} is neither http://host:port nor unix:/path/to.sock; set it to one."
    )
