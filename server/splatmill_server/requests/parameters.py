"""The parameters that several endpoints share."""

from typing import Annotated, Any

from fastapi import Depends, Query, Request

from splatmill.schema import ListOrder
from splatmill_server.base.paging import MAX_LIMIT
from splatmill_server.base.problems import ProblemError

Cursor = Annotated[
    str | None,
    Query(max_length=200, description="The `cursor` of the previous page. Left out, the first page."),
]
Limit = Annotated[int, Query(ge=1, le=MAX_LIMIT, description="Largest number of entries in a page.")]
NamePart = Annotated[
    str | None,
    Query(
        max_length=200, description="List only records whose name contains this text, in any case and accent."
    ),
]

TagOf = Annotated[
    str | None,
    Query(max_length=40, description="List only records with this tag, in any case and accent."),
]
Favourite = Annotated[
    bool | None, Query(description="List only records with a star, or, if false, only those without one.")
]


Sort = Annotated[ListOrder, Query(description="What comes first.")]


async def _json_only(request: Request) -> None:  # as a coroutine, it takes no thread of the pool
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    has_body = request.headers.get("content-length", "0") != "0" or "transfer-encoding" in request.headers
    if has_body and media_type != "application/json" and not media_type.endswith("+json"):
        raise ProblemError(
            "unsupported_media_type",
            f"This address accepts JSON; the content type is {media_type[:80] or 'missing'!r}.",
            advice="Send the header 'Content-Type: application/json'.",
        )


JSON_ONLY: Any = Depends(_json_only)
"""A dependency that refuses a body that is not JSON with a 415 problem, before the body is parsed."""
