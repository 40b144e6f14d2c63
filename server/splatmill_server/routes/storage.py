"""The endpoint of `/v1/storage`: who has how much in storage."""

from typing import Annotated

from fastapi import APIRouter, Query

from splatmill.schema import PlannedDeletion, StorageUse
from splatmill_server.access.caller import Caller, Who
from splatmill_server.background.sweeper import MOST
from splatmill_server.requests.ownership import ListedOwner
from splatmill_server.routes.openapi import problems
from splatmill_server.service import Service, Shared
from splatmill_server.space.ledger import NOBODY
from splatmill_server.space.retention import expiry, plan
from splatmill_server.space.usage import largest

router = APIRouter(tags=["service"])

OLDEST = 10.0
"""Seconds: a request for figures that are older scans storage."""


@router.get("/v1/storage", responses=problems("storage_unavailable"))
def get_storage(
    service: Shared,
    who: Who,
    owner: ListedOwner,
    count: Annotated[
        int, Query(alias="largest", ge=0, le=1000, description="Number of the largest records to list.")
    ] = 20,
) -> StorageUse:
    """Get what the caller's records occupy in storage; for an admin, those of every owner."""
    usage = service.usage
    usage.refresh(OLDEST)
    owners = usage.ledger.owners() if owner is None else [owner]
    uses = [usage.owner_use(account, _limit(service, who, account)) for account in owners]
    snapshot, ages = usage.snapshot(), service.sweeper.ages
    deletions = [
        PlannedDeletion(
            kind=account.action,
            id=account.held.id,
            owner=account.held.owner,
            bytes=account.bytes,
            reason=account.reason,
        )
        for account in plan(snapshot, ages, usage.ledger.clock())
        if owner is None or account.held.owner == owner
    ]
    return StorageUse(
        scanned_at=usage.scanned_at(),
        owners=sorted(uses, key=lambda use: (-use.bytes, use.owner or "")),
        largest=largest(snapshot, expiry(snapshot, ages), owner, count),
        deletions=deletions[:MOST],
    )


def _limit(service: Service, who: Caller, owner: str) -> int | None:
    if owner == NOBODY:
        return None
    return service.quota.limit(who, owner) if who.owner == owner else service.quota.known_limit(owner)
