"""The synchronous twins of the classes in `bin`, `imports`, `keys`, `meshes`, `orbits`, `shares`, `webhooks`.

Generated from these by `make generated`.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Unpack

from splatmill.schema import (
    DEFAULT_OWNER,
    Binned,
    Delivery,
    Import,
    Key,
    KeyLimits,
    KeyWithSecret,
    Mesh,
    Orbit,
    Role,
    Scope,
    Share,
    ShareWithToken,
    Webhook,
    WebhookEvent,
    WebhookWithSecret,
)
from splatmill.sdk.arguments import MeshArguments, OrbitArguments
from splatmill.sdk.bin import AsyncBin
from splatmill.sdk.imports import AsyncImports
from splatmill.sdk.keys import AsyncKeys
from splatmill.sdk.loop import BackgroundLoop
from splatmill.sdk.meshes import AsyncMeshes
from splatmill.sdk.orbits import AsyncOrbits
from splatmill.sdk.shares import AsyncShares
from splatmill.sdk.webhooks import AsyncWebhooks
from splatmill.transfer.downloads import AnyPath
from splatmill.transfer.uploads import OnProgress


class Bin:
    """Puts jobs with their models, and captures, into the bin of a server, lists and restores them.

    Lists do not show what is in the bin, links to its models open nothing, and its bytes still count. The server
    deletes it for good a day after it was put there.
    """

    def __init__(self, loop: BackgroundLoop, twin: AsyncBin) -> None:
        self._loop = loop
        self._async = twin

    def list(self) -> list[Binned]:
        """Return what is in the bin, the newest first."""
        return self._loop.run(self._async.list())

    def put_job(self, job_id: str) -> Binned:
        """Put a job that has ended into the bin, with its model, which has the same id.

        Raises NotFound, and Conflict for a job that has not ended or whose model an unfinished job starts from.
        """
        return self._loop.run(self._async.put_job(job_id))

    def put_capture(self, capture_id: str) -> Binned:
        """Put a capture into the bin. Raises NotFound, and Conflict for one that an unfinished job uses."""
        return self._loop.run(self._async.put_capture(capture_id))

    def restore_job(self, job_id: str) -> None:
        """Restore a job and its model. Raises NotFound for one that is not in the bin."""
        self._loop.run(self._async.restore_job(job_id))

    def restore_capture(self, capture_id: str) -> None:
        """Restore a capture. Raises NotFound for one that is not in the bin."""
        self._loop.run(self._async.restore_capture(capture_id))


class Imports:
    """Lets the server fetch files of a capture, and reports how far they are."""

    def __init__(self, loop: BackgroundLoop, twin: AsyncImports) -> None:
        self._loop = loop
        self._async = twin

    def start(
        self,
        url: str,
        *,
        capture: str | None = None,
        role: Role | str = Role.images,
        name: str | None = None,
        sha256: str | None = None,
    ) -> Import:
        """Let the server fetch a file of a capture from an address, in the background.

        url: public address of the file, http:// or https://.
        capture: id of the capture; left out, a new one, whose id is that of the returned import.
        role: its purpose in the capture.
        name: its name there; left out, the last part of the address.
        sha256: SHA-256 of its bytes in hex, checked if given.

        Raises NotFound, and InvalidRequest for an address that the server does not use.
        """
        return self._loop.run(self._async.start(url, capture=capture, role=role, name=name, sha256=sha256))

    def get(self, capture: str, import_id: str) -> Import:
        """Return an import: its state, the bytes received, and at the end the file or the problem."""
        return self._loop.run(self._async.get(capture, import_id))

    def wait(self, capture: str, import_id: str, on_progress: OnProgress | None = None) -> Import:
        """Wait for the end of an import and return it, also where it has failed.

        on_progress: called with the bytes received.
        """
        return self._loop.run_reporting(
            lambda report: self._async.wait(capture, import_id, report), on_progress
        )

    def list(self, capture: str) -> list[Import]:
        """Return the imports of a capture, newest first."""
        return self._loop.run(self._async.list(capture))


class Keys:
    """Creates, lists, revokes and rotates the keys of a server."""

    def __init__(self, loop: BackgroundLoop, twin: AsyncKeys) -> None:
        self._loop = loop
        self._async = twin

    def create(
        self,
        name: str,
        *,
        owner: str = DEFAULT_OWNER,
        scopes: Iterable[Scope | str] = (Scope.read, Scope.train),
        limits: KeyLimits | Mapping[str, Any] | None = None,
    ) -> KeyWithSecret:
        """Create a key. `secret` of the returned key is what clients send; the server cannot show it again.

        limits: `unfinished_jobs`, `bytes_stored` and `requests_per_minute`; what is left out has no limit.

        Raises Conflict if the first key of a server does not have the scope admin.
        """
        return self._loop.run(self._async.create(name, owner=owner, scopes=scopes, limits=limits))

    def list(self) -> list[Key]:
        """Return the keys, the oldest first."""
        return self._loop.run(self._async.list())

    def revoke(self, key_id: str) -> None:
        """Revoke a key. The server refuses it within two seconds.

        Raises NotFound, and Conflict for the last key with the scope admin.
        """
        self._loop.run(self._async.revoke(key_id))

    def rotate(self, key_id: str, *, grace: float | str = 0.0) -> KeyWithSecret:
        """Give a key a new secret. The former one stays valid for `grace`: seconds, or a text such as `1h`."""
        return self._loop.run(self._async.rotate(key_id, grace=grace))


class Meshes:
    """Starts, follows, lists and deletes the meshes of a model, which the server makes in the background."""

    def __init__(self, loop: BackgroundLoop, twin: AsyncMeshes) -> None:
        self._loop = loop
        self._async = twin

    def start(self, **options: Unpack[MeshArguments]) -> Mesh:
        """Let the server make a mesh in the background, and keep it with the model.

        `options` are the fields of `MeshRequest`. The same options return the same mesh, also one that is whole. Raises
        InvalidRequest for options that are not valid, and Conflict where there are too many meshes.
        """
        return self._loop.run(self._async.start(**options))

    def get(self, mesh_id: str) -> Mesh:
        """Return a mesh: its state, what is being done, and at the end its triangles and size, or the problem.

        Raises NotFound for a mesh that does not exist.
        """
        return self._loop.run(self._async.get(mesh_id))

    def wait(self, mesh_id: str, on_progress: OnProgress | None = None) -> Mesh:
        """Wait until a mesh is whole, and return it.

        on_progress: called with what is being done.

        Raises a subclass of `Refused` with the problem of a mesh that has failed, and NotFound for one that somebody
        deletes meanwhile.
        """
        return self._loop.run_reporting(lambda report: self._async.wait(mesh_id, report), on_progress)

    def list(self) -> list[Mesh]:
        """Return the meshes of the model, newest first."""
        return self._loop.run(self._async.list())

    def download(self, mesh_id: str, path: AnyPath) -> Path:
        """Download a mesh that is whole to `path`, a file or an existing folder, and return the path written.

        Raises Conflict for a mesh that is not whole, NotFound, DownloadFailed, ConnectionFailed or OSError.
        """
        return self._loop.run(self._async.download(mesh_id, path))

    def delete(self, mesh_id: str) -> None:
        """Delete a mesh; one that is not whole is not made any further.

        Raises NotFound for a mesh that does not exist.
        """
        self._loop.run(self._async.delete(mesh_id))


class Orbits:
    """Starts, follows, lists and deletes the videos that circle a model, which the server renders in the background."""

    def __init__(self, loop: BackgroundLoop, twin: AsyncOrbits) -> None:
        self._loop = loop
        self._async = twin

    def start(self, **options: Unpack[OrbitArguments]) -> Orbit:
        """Let the server render a video in the background, and keep it with the model.

        `options` are the fields of `OrbitRequest`. The same options return the same video, also one that is whole.
        Raises InvalidRequest for options that are not valid, and Conflict where there are too many videos.
        """
        return self._loop.run(self._async.start(**options))

    def get(self, orbit_id: str) -> Orbit:
        """Return a video: its state, the frames that are rendered, and at the end its size or the problem.

        Raises NotFound for a video that does not exist.
        """
        return self._loop.run(self._async.get(orbit_id))

    def wait(self, orbit_id: str, on_progress: OnProgress | None = None) -> Orbit:
        """Wait until a video is whole, and return it.

        on_progress: called with the number of frames that are rendered.

        Raises a subclass of `Refused` with the problem of a video that has failed, and NotFound for one that somebody
        deletes meanwhile.
        """
        return self._loop.run_reporting(lambda report: self._async.wait(orbit_id, report), on_progress)

    def list(self) -> list[Orbit]:
        """Return the videos of the model, newest first."""
        return self._loop.run(self._async.list())

    def download(self, orbit_id: str, path: AnyPath) -> Path:
        """Download a video that is whole to `path`, a file or an existing folder, and return the path written.

        Raises Conflict for a video that is not whole, NotFound, DownloadFailed, ConnectionFailed or OSError.
        """
        return self._loop.run(self._async.download(orbit_id, path))

    def delete(self, orbit_id: str) -> None:
        """Delete a video; one that is not whole is not rendered any further.

        Raises NotFound for a video that does not exist.
        """
        self._loop.run(self._async.delete(orbit_id))


class Shares:
    """Creates, lists and revokes the links to a model. Whoever has a link may see the model, without a key."""

    def __init__(self, loop: BackgroundLoop, twin: AsyncShares) -> None:
        self._loop = loop
        self._async = twin

    def create(
        self, *, expires_in: float | str = "30d", name: str | None = None, photos: bool = False
    ) -> ShareWithToken:
        """Create a link. `path` of the returned one is its address on the server, which cannot show it again.

        expires_in: for how long it is valid: seconds, or a text such as 12h or 30d.
        photos: whether the held-out photos and the page of the report, which shows some, go along.

        Raises InvalidRequest for a time that is not valid.
        """
        return self._loop.run(self._async.create(expires_in=expires_in, name=name, photos=photos))

    def revoke(self, share_id: str) -> None:
        """Revoke a link at once and for good."""
        self._loop.run(self._async.revoke(share_id))

    def list(self) -> list[Share]:
        """Return the links, newest first, also those that have ended, without their tokens."""
        return self._loop.run(self._async.list())


class Webhooks:
    """Creates, lists and deletes webhooks, and reads the log of their deliveries."""

    def __init__(self, loop: BackgroundLoop, twin: AsyncWebhooks) -> None:
        self._loop = loop
        self._async = twin

    def create(
        self, url: str, *, events: Iterable[WebhookEvent | str] | None = None, name: str | None = None
    ) -> WebhookWithSecret:
        """Create a webhook. `secret` of the returned one verifies its requests; the server cannot show it again.

        events: `job.succeeded`, `job.failed` and `job.cancelled`; left out, all of them.

        Raises InvalidRequest for an address that the server sends nothing to.
        """
        return self._loop.run(self._async.create(url, events=events, name=name))

    def delete(self, webhook_id: str) -> None:
        """Delete a webhook and its log."""
        self._loop.run(self._async.delete(webhook_id))

    def rotate(self, webhook_id: str) -> WebhookWithSecret:
        """Give a webhook a new secret. For 24 hours, its requests are signed with the former one too."""
        return self._loop.run(self._async.rotate(webhook_id))

    def enable(self, webhook_id: str) -> Webhook:
        """Let the server send to a disabled webhook again."""
        return self._loop.run(self._async.enable(webhook_id))

    def deliveries(self, webhook_id: str) -> list[Delivery]:
        """Return the deliveries of a webhook, newest first, with every attempt."""
        return self._loop.run(self._async.deliveries(webhook_id))

    def repeat(self, webhook_id: str, delivery_id: str) -> Delivery:
        """Let the server send a delivery that is over once more."""
        return self._loop.run(self._async.repeat(webhook_id, delivery_id))

    def list(self) -> list[Webhook]:
        """Return the webhooks, the oldest first."""
        return self._loop.run(self._async.list())
