"""What schemathesis is told by `bench openapi`: ids of records that exist, and addresses of this machine alone.

A made-up id names nothing, so that most requests would end as 404. Every other id is replaced by one of the service's
own, which are asked for from time to time, since requests make and delete records. The one whole model, and its job
and share, are never given to DELETE, as nothing could be rendered after it.

Addresses that the service would fetch or deliver to become one on which nobody listens. Of the videos that take
seconds or minutes, the first ones of a round are rendered whole, and the others have one frame.
"""

import json
import math
import os
import zlib
from typing import Any

import httpx
import schemathesis

SERVICE: dict[str, Any] = json.loads(os.environ["SPLATMILL_BENCH_OPENAPI"])
"""url and key of the service; `kept`: ids by the name of the path parameter, of records that stay."""

NOBODY = "http://127.0.0.1:9/photos.zip"
"""The port of the service `discard`, on which nothing listens."""

AFTER = 200
"""Requests after which the ids of records are asked for again."""

LONG_VIDEOS, VIDEO_PIXELS = 3, 2e6
"""How many videos of more pixels, in all their frames, are rendered whole in a round. They may take a minute each."""

_VIDEO = {"seconds": 6.0, "fps": 24, "width": 640, "height": 480}
"""What a video is without these fields."""

_FORMATS = ("ply", "sog", "spz", "glb", "compressed.ply")
_FILES = ("model.ply", "report.json", "cameras.json", "a.jpg", "0000.jpg")

_known: dict[str, list[str]] = {}
_asked = 0
_long_videos = 0

schemathesis.serializer.alias("application/partial-upload", "application/octet-stream")


@schemathesis.hook
def map_path_parameters(context: Any, path_parameters: dict[str, Any] | None) -> dict[str, Any] | None:
    """Replace every other made-up id by one of a record."""
    if not path_parameters:
        return path_parameters
    return {
        name: _existing(name, str(value), context.operation.method) for name, value in path_parameters.items()
    }


@schemathesis.hook
def map_body(context: Any, body: Any) -> Any:
    """Replace addresses, and every other capture."""
    if isinstance(body, dict):
        if isinstance(body.get("url"), str):
            body = body | {"url": NOBODY}
        if isinstance(body.get("capture"), str):
            body = body | {"capture": _existing("capture_id", body["capture"], "POST")}
    return body


@schemathesis.hook
def before_call(context: Any, case: Any, kwargs: dict[str, Any]) -> None:
    """Leave one frame of a video of more than VIDEO_PIXELS in all frames, but for the first LONG_VIDEOS of a round."""
    global _long_videos
    if isinstance(case.body, dict) and case.operation.path.endswith(("/orbit", "/orbits")):
        sizes = [case.body.get(name, default) for name, default in _VIDEO.items()]
        if all(isinstance(size, int | float) for size in sizes) and math.prod(sizes) > VIDEO_PIXELS:
            _long_videos += 1
            if _long_videos > LONG_VIDEOS:
                case.body = case.body | {"seconds": 0.5, "fps": 1}


def _existing(name: str, made_up: str, method: str) -> str:
    drawn = zlib.crc32(made_up.encode("utf-8", "surrogatepass"))
    if drawn % 2:
        return made_up
    ids = _ids().get(name, [])
    if method.upper() == "DELETE":
        ids = [one for one in ids if one not in SERVICE["kept"].get(name, [])]
    return ids[drawn // 2 % len(ids)] if ids else made_up


def _ids() -> dict[str, list[str]]:
    global _asked
    if _asked % AFTER == 0:
        _known.update(_look())
    _asked += 1
    return _known


def _look() -> dict[str, list[str]]:
    """Ask the service for the ids of its records, by the name of the path parameter."""
    by_name: dict[str, list[str]] = {name: list(ids) for name, ids in SERVICE["kept"].items()}
    headers = {"Authorization": f"Bearer {SERVICE['key']}"}
    with httpx.Client(base_url=SERVICE["url"], headers=headers, timeout=60, trust_env=False) as http:
        for name, path in (
            ("capture_id", "captures"),
            ("job_id", "jobs"),
            ("key_id", "keys"),
            ("webhook_id", "webhooks"),
        ):
            listed = http.get(f"/v1/{path}").json()
            rows = (
                listed
                if isinstance(listed, list)
                else next(v for v in listed.values() if isinstance(v, list))
            )
            by_name[name] = [*by_name.get(name, []), *(row["id"] for row in rows)]
    return by_name | {"role": ["images", "masks", "poses"], "format": list(_FORMATS), "name": list(_FILES)}
