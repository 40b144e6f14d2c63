"""The endpoints of `/v1/session`: a browser exchanges a key for a cookie that scripts cannot read."""

from fastapi import APIRouter, Request
from starlette.responses import Response

from splatmill.schema import Scope
from splatmill_server.access.authentication import bearer, session_cookie
from splatmill_server.access.browsers import check_origin
from splatmill_server.access.caller import Who
from splatmill_server.access.keys import digest
from splatmill_server.access.permission import needs
from splatmill_server.access.sessions import COOKIE, Session
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.root_path import address
from splatmill_server.routes.openapi import answer, problems
from splatmill_server.service import Shared

router = APIRouter(prefix="/v1/session", tags=["keys"])


@router.post(
    "",
    status_code=204,
    responses=answer(
        204,
        "The session has begun",
        headers={"Set-Cookie": {"schema": {"type": "string"}, "description": "The cookie of the session."}},
    )
    | problems("origin_not_allowed", "session_needs_key"),
)
@needs(Scope.read)
async def begin_session(service: Shared, who: Who, request: Request) -> Response:
    """Begin a session with the key in `Authorization`: until it ends, requests with its cookie are those of the key."""
    secret = bearer(request.headers)
    if secret is None or who.by_session or not who.with_key:
        raise ProblemError(
            "session_needs_key",
            "A session is made from an API key in the header Authorization, and this request has none.",
            advice="Send the header 'Authorization: Bearer KEY'. A server without keys needs no session.",
        )
    check_origin(request.scope, request.headers, service.settings.own_names, required=False)
    cookie = await service.sessions.create(Session(who.key_id, digest(secret)))
    secure = request.url.scheme == "https" or request.headers.get("origin", "").startswith("https://")
    response = Response(status_code=204, headers={"Cache-Control": "no-store"})
    response.set_cookie(
        COOKIE,
        cookie,
        max_age=service.sessions.seconds,
        path=address("/"),
        secure=secure,
        httponly=True,
        samesite="strict",
    )
    return response


@router.delete(
    "", status_code=204, responses=answer(204, "The session has ended") | problems("origin_not_allowed")
)
@needs(Scope.read)
async def end_session(service: Shared, request: Request) -> Response:
    """End the session of the cookie, if there is one."""
    if (cookie := session_cookie(request.headers)) is not None:
        await service.sessions.delete(cookie)
    response = Response(status_code=204)
    response.delete_cookie(COOKIE, path=address("/"), httponly=True, samesite="strict")
    return response
