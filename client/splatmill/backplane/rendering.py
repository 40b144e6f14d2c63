"""How the server talks to the renderer process: HTTP, on a port or a unix socket, by these paths.

Bodies and answers are those of the public API (`RenderRequest`, `OrbitRequest`, problem documents), so that the
server only forwards. `If-None-Match` travels along; the renderer makes the ETag and answers 304 itself.
"""

HEALTH = "/healthz"


def render_path(model_id: str) -> str:
    """POST a `RenderRequest`; the answer is the picture."""
    return f"/v1/models/{model_id}/render"


def orbit_path(model_id: str) -> str:
    """POST an `OrbitRequest`; the answer is an MP4."""
    return f"/v1/models/{model_id}/orbit"


def address(url: str) -> tuple[str, str | None]:
    """The base URL and, for `unix:/path/to.sock`, the socket path to reach it by.

    Raises ValueError with a sentence for anything but `http://host:port`, `https://...` and `unix:/path`.
    """
    if url.startswith("unix:"):
        path = url.removeprefix("unix:").removeprefix("//")
        if path.startswith("/"):
            return "http://renderer", path
    elif url.startswith(("http://", "https://")):
        return url.rstrip("/"), None
    raise ValueError(f"SPLATMILL_RENDERER_URL={url!r} is neither http://host:port nor unix:/path/to.sock.")
