"""What the endpoints of an app share: connections, settings and records. `create_app` makes one per app."""

import asyncio
import ssl
import threading
import time
from dataclasses import dataclass, field
from typing import Annotated, cast

import httpx
import structlog
from fastapi import Depends, Request
from redis import Redis
from redis.asyncio import Redis as AsyncRedis

from splatmill.backplane import rendering
from splatmill.backplane.connection import connect, connect_async
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill_server.access.authentication import Authentication
from splatmill_server.access.keys import Keys
from splatmill_server.access.rate import Rate
from splatmill_server.access.sessions import Sessions
from splatmill_server.admission import Admission
from splatmill_server.background.conversions import Conversions
from splatmill_server.background.deliveries import Deliveries
from splatmill_server.background.ends import Ends
from splatmill_server.background.imports import Imports
from splatmill_server.background.meshes import Meshes
from splatmill_server.background.orbits import Orbits
from splatmill_server.background.reaper import Reaper
from splatmill_server.background.relisting import Relisting
from splatmill_server.background.sweeper import Sweeper
from splatmill_server.base.feed import Feed
from splatmill_server.base.lists import Lists
from splatmill_server.base.metrics import Metrics
from splatmill_server.base.outgoing import Outgoing
from splatmill_server.base.problems import storage_trouble
from splatmill_server.base.renderer import CountingTransport
from splatmill_server.base.settings import Settings
from splatmill_server.captures.partial_uploads import PartialUploads
from splatmill_server.captures.records import Captures
from splatmill_server.jobs.finished import Finished
from splatmill_server.jobs.records import Jobs
from splatmill_server.models import Models
from splatmill_server.presentations import Presentations
from splatmill_server.shares import Shares
from splatmill_server.space.bin import Bin
from splatmill_server.space.deletion import Deletion
from splatmill_server.space.ledger import Ledger
from splatmill_server.space.quota import Quota
from splatmill_server.space.retention import Ages
from splatmill_server.space.usage import Usage
from splatmill_server.webhooks import Webhooks

log = structlog.get_logger()

CHECK_SECONDS = 5.0
"""Seconds for which a check of storage holds: everybody may request `/readyz`, and each check writes a file."""

_CHECK_WAIT = 1.0
"""Seconds that a request waits for the check of another one, which a storage that does not answer may hold up."""


class StorageCheck:
    """Checks by a write whether storage can be used, at most once in CHECK_SECONDS.

    Anybody may read the result; the message of an error, which may name folders, hosts and buckets, is logged.
    """

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._lock = threading.Lock()
        self._checked = float("-inf")
        self._result = ""

    def result(self) -> str:
        """Return "ok" or what is wrong, as of the last check."""
        if not self._lock.acquire(timeout=_CHECK_WAIT):
            return "Storage does not answer: a check of it has not ended."
        try:
            if time.monotonic() - self._checked >= CHECK_SECONDS:
                try:
                    self._storage.check()
                    self._result = "ok"
                except StorageError as error:
                    log.warning("storage is not ready", error=str(error))
                    self._result = storage_trouble(error)
                self._checked = time.monotonic()
            return self._result
        finally:
            self._lock.release()


@dataclass
class Service:
    """The state of an app. Connections are opened on first use, so an app can be created before Redis runs."""

    settings: Settings
    redis: Redis
    redis_async: AsyncRedis
    feed: Feed
    storage: Storage
    storage_check: StorageCheck
    renderer: httpx.AsyncClient | None
    metrics: Metrics
    captures: Captures
    partial_uploads: PartialUploads
    imports: Imports
    outgoing: Outgoing
    webhooks: Webhooks
    deliveries: Deliveries
    jobs: Jobs
    lists: Lists
    finished: Finished
    models: Models
    shares: Shares
    conversions: Conversions
    orbits: Orbits
    meshes: Meshes
    presentations: Presentations
    keys: Keys
    authentication: Authentication
    sessions: Sessions
    rate: Rate
    reaper: Reaper
    ends: Ends
    usage: Usage
    quota: Quota
    admission: Admission
    deletion: Deletion
    bin: Bin
    relisting: Relisting
    sweeper: Sweeper
    closing: asyncio.Event = field(default_factory=asyncio.Event)
    """Set when the server is stopped, so that event streams end and do not delay it."""

    @classmethod
    def of(cls, settings: Settings) -> "Service":
        """Return the state for these settings. Raises StorageError if storage cannot be opened."""
        metrics = Metrics()
        storage = Storage(settings.storage, on_operation=metrics.storage_operation)
        redis_async = connect_async(settings.redis_url)
        connection = connect(settings.redis_url, timeout=settings.redis_timeout, retries=1)
        lists = Lists(connection)
        finished = Finished(storage, lists)
        jobs = Jobs(connection, storage, metrics, lists)
        models = Models(storage, jobs, lists)
        captures = Captures(storage, settings, metrics, lists)
        usage = Usage(storage, Ledger(connection))
        quota = Quota(usage, captures, settings.quota)
        jobs.on_end.append(quota.job_ended)
        deletion = Deletion(connection, storage, captures, jobs, usage.ledger)
        records_bin = Bin(connection, storage, captures, jobs, deletion)
        # Queued jobs do not wait for the others; what is in the bin is known before it could be listed.
        lists.makers += [jobs.make_lists, records_bin.make, captures.make_lists, models.make_lists]
        outgoing = Outgoing(settings.outgoing_allow)
        webhooks = Webhooks(storage, jobs)
        renderer = _renderer(settings, metrics)
        stored_keys = Keys(storage, connection, bootstrap=settings.api_key is not None)
        sessions = Sessions(redis_async, settings.session_seconds, settings.redis_timeout)
        return cls(
            settings=settings,
            redis=connection,
            redis_async=redis_async,
            feed=Feed(redis_async),
            storage=storage,
            storage_check=StorageCheck(storage),
            renderer=renderer,
            metrics=metrics,
            captures=captures,
            partial_uploads=PartialUploads(storage, captures),
            imports=Imports(connection, storage, captures, quota, outgoing, settings),
            outgoing=outgoing,
            webhooks=webhooks,
            deliveries=Deliveries(connection, webhooks, outgoing, metrics),
            jobs=jobs,
            lists=lists,
            finished=finished,
            models=models,
            shares=Shares(storage, connection, models),
            conversions=Conversions(storage, connection, models, renderer, quota, settings.orbit_timeout),
            orbits=Orbits(storage, connection, models, renderer, quota, settings.orbit_timeout),
            meshes=Meshes(storage, connection, models, renderer, quota, settings.orbit_timeout),
            presentations=Presentations(
                storage, connection, models, renderer, quota, settings.render_timeout
            ),
            keys=stored_keys,
            authentication=Authentication(settings, stored_keys, sessions),
            sessions=sessions,
            rate=Rate(redis_async),
            reaper=Reaper(connection, jobs, metrics, settings),
            ends=Ends(redis_async, jobs),
            usage=usage,
            quota=quota,
            admission=Admission(storage, captures, jobs, models, quota, records_bin, finished),
            deletion=deletion,
            bin=records_bin,
            relisting=Relisting(connection, storage, captures, models, settings.reaper_interval),
            sweeper=Sweeper(
                usage, deletion, records_bin, captures, models, _ages(settings), settings.sweep_interval
            ),
        )

    async def close(self) -> None:
        """Close every connection."""
        await self.feed.stop()
        await self.redis_async.aclose()
        self.redis.close()
        if self.renderer is not None:
            await self.renderer.aclose()


def _ages(settings: Settings) -> Ages:
    return Ages(
        captures=settings.keep_captures,
        failed_jobs=settings.keep_failed_jobs,
        work=settings.keep_work,
        models=settings.keep_models,
        orphans=settings.keep_orphans,
    )


def _renderer(settings: Settings, metrics: Metrics) -> httpx.AsyncClient | None:
    if settings.renderer_url is None:
        return None
    base, socket = rendering.address(settings.renderer_url)
    # The renderer has a private address, so requests to it must not go through a proxy. It speaks no TLS, and to load
    # certificates would take as long as the rest of the app's start.
    untrusting = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    transport = CountingTransport(
        httpx.AsyncHTTPTransport(uds=socket, trust_env=False, verify=untrusting), metrics
    )
    return httpx.AsyncClient(base_url=base, transport=transport, trust_env=False)


async def _service(request: Request) -> Service:  # as a coroutine, it takes no thread of the pool
    return cast(Service, request.app.state.service)


Shared = Annotated[Service, Depends(_service)]
"""The parameter through which an endpoint receives the service."""
