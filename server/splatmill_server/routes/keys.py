"""The endpoints of `/v1/keys`, for admins, and `/v1/me`, which answers who the caller is."""

from typing import Annotated

from fastapi import APIRouter, Body, Path
from starlette.responses import Response

from splatmill.schema import CreateKey, Key, KeyList, KeyWithSecret, Me, RotateKey, Scope, Use
from splatmill_server.access.caller import Who
from splatmill_server.access.permission import needs
from splatmill_server.requests.parameters import JSON_ONLY
from splatmill_server.routes.openapi import JSON_BODY, problems
from splatmill_server.service import Shared

router = APIRouter(prefix="/v1", tags=["keys"])

KeyId = Annotated[str, Path(description="Id of the key, which is also a part of its secret.")]

_BODY = problems(*JSON_BODY, "storage_full")
_NOT_STORED = {"Cache-Control": "no-store"}  # the answer holds a secret


@router.post(
    "/keys", status_code=201, responses=_BODY | problems("admin_key_needed"), dependencies=[JSON_ONLY]
)
@needs(Scope.admin)
def create_key(
    service: Shared,
    response: Response,
    request: Annotated[CreateKey, Body(examples=[{"name": "Ann's laptop", "owner": "ann"}])],
) -> KeyWithSecret:
    """Create a key. Its secret is in this answer and nowhere else: the server stores a digest of it."""
    response.headers.update(_NOT_STORED)
    made = service.keys.create(request)
    response.headers["Location"] = f"/v1/keys/{made.id}"
    return made


@router.get("/keys", responses=problems())
@needs(Scope.admin)
def list_keys(service: Shared) -> KeyList:
    """List the keys, the oldest first, without their secrets."""
    return KeyList(keys=service.keys.list())


@router.get("/keys/{key_id}", responses=problems("key_not_found"))
@needs(Scope.admin)
def get_key(service: Shared, key_id: KeyId) -> Key:
    """Get a key without its secret."""
    return service.keys.get(key_id).public()


@router.delete("/keys/{key_id}", status_code=204, responses=problems("key_not_found", "admin_key_needed"))
@needs(Scope.admin)
def revoke_key(service: Shared, key_id: KeyId) -> Response:
    """Revoke a key. Every API process refuses it within two seconds."""
    service.keys.revoke(key_id)
    return Response(status_code=204)


@router.post("/keys/{key_id}/rotate", responses=_BODY | problems("key_not_found"), dependencies=[JSON_ONLY])
@needs(Scope.admin)
def rotate_key(
    service: Shared,
    response: Response,
    key_id: KeyId,
    request: Annotated[RotateKey | None, Body(examples=[{"grace": "1h"}])] = None,
) -> KeyWithSecret:
    """Give a key a new secret. The former one stays valid for `grace`; left out, it is refused at once."""
    response.headers.update(_NOT_STORED)
    return service.keys.rotate(key_id, (request or RotateKey()).grace)


@router.get("/me", responses=problems())
def get_me(service: Shared, who: Who) -> Me:
    """Get the owner, scopes, limits and use of the caller."""
    return Me(
        owner=who.owner,
        key=who.key_id,
        key_name=who.key_name,
        scopes=[scope for scope in Scope if who.has(scope)],
        limits=who.limits,
        use=Use(unfinished_jobs=service.jobs.count_unfinished(who.owner)),
    )
