"""What the endpoints of an app share: connections, settings and records. `create_app` makes one per app."""

import asyncio
from dataclasses import dataclass, field
from typing import Annotated, cast

import httpx
from fastapi import Depends, Request
from redis import Redis
from redis.asyncio import Redis as AsyncRedis

from splatmill.backplane import rendering
from splatmill.backplane.connection import connect, connect_async
from splatmill.backplane.storage import Storage
from splatmill_server.captures import Captures
from splatmill_server.jobs import Jobs
from splatmill_server.metrics import Metrics
from splatmill_server.models import Models
from splatmill_server.reaper import Reaper
from splatmill_server.settings import Settings


@dataclass
class Service:
    """The state of an app. Connections are opened on first use, so an app can be created before Redis runs."""

    settings: Settings
    redis: Redis
    redis_async: AsyncRedis
    storage: Storage
    renderer: httpx.AsyncClient | None
    metrics: Metrics
    captures: Captures
    jobs: Jobs
    models: Models
    reaper: Reaper
    closing: asyncio.Event = field(default_factory=asyncio.Event)
    """Set when the server is stopped, so that event streams end and do not delay it."""

    @classmethod
    def of(cls, settings: Settings) -> "Service":
        """Return the state for these settings. Raises StorageError if storage cannot be opened."""
        storage = Storage(settings.storage)
        connection = connect(settings.redis_url, timeout=settings.redis_timeout, retries=1)
        metrics = Metrics()
        jobs = Jobs(connection, storage, metrics)
        return cls(
            settings=settings,
            redis=connection,
            redis_async=connect_async(settings.redis_url),
            storage=storage,
            renderer=_renderer(settings),
            metrics=metrics,
            captures=Captures(storage, settings, metrics),
            jobs=jobs,
            models=Models(storage, jobs),
            reaper=Reaper(connection, jobs, metrics, settings),
        )

    async def close(self) -> None:
        """Close every connection."""
        await self.redis_async.aclose()
        self.redis.close()
        if self.renderer is not None:
            await self.renderer.aclose()


def _renderer(settings: Settings) -> httpx.AsyncClient | None:
    if settings.renderer_url is None:
        return None
    base, socket = rendering.address(settings.renderer_url)
    # The renderer has a private address, so requests to it must not go through a proxy.
    transport = httpx.AsyncHTTPTransport(uds=socket) if socket else None
    return httpx.AsyncClient(base_url=base, transport=transport, trust_env=False)


def _service(request: Request) -> Service:
    return cast(Service, request.app.state.service)


Shared = Annotated[Service, Depends(_service)]
"""The parameter through which an endpoint receives the service."""
