"""How models are shown to people: reads and saves it, and keeps the picture that each model has from its start view.

models/{id}/presentation.json is the record, and models/{id}/poster.jpg the picture. Only this module writes them.
"""

import json
from collections.abc import Callable

import httpx
import redis
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import rendering
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import FORMAT, UnreadableRecord, check_format, reason, warn
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import (
    DEFAULT_OWNER,
    POSTER,
    CameraSpec,
    ChangePresentation,
    Format,
    Presentation,
    Problem,
    RenderRequest,
)
from splatmill.schema.tolerant import keep_readable
from splatmill_server.access.caller import Caller
from splatmill_server.base.leases import exclusive
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.renderer import post
from splatmill_server.models import Models, model_not_found
from splatmill_server.space.quota import Quota

POSTER_SIDE = 1280
"""Longer side of a picture from a start view, pixels."""

POSTER_QUALITY = 88


class Presentations:
    """All operations on how models are shown.

    seconds: how long the renderer may take for a picture.
    """

    def __init__(
        self,
        storage: Storage,
        connection: redis.Redis,
        models: Models,
        renderer: httpx.AsyncClient | None,
        quota: Quota,
        seconds: float,
    ) -> None:
        self._storage = storage
        self._connection = connection
        self._models = models
        self._renderer = renderer
        self._quota = quota
        self._seconds = seconds

    def get(self, model_id: str) -> Presentation:
        """Return how a model is shown; what cannot be read counts as not saved. Raises 404 and 409 problems."""
        self._models.check(model_id)
        try:
            return self._read(model_id)
        except UnreadableRecord as error:
            warn(layout.presentation(model_id), str(error))
            return Presentation()

    async def save(self, model_id: str, change: ChangePresentation, who: Caller, client: str) -> Presentation:
        """Change how a model is shown, and return the whole of it. If anything fails, nothing has changed.

        client: for whom the picture is rendered, as `rendering.client_of` writes it.

        Raises 404 and 409 problems, 503 and 504 problems of the renderer where another picture is needed, and a 507
        problem where the quota is used up.
        """
        while True:
            before, has_poster = await run_in_threadpool(self._known, model_id)
            after = before.model_copy(
                update={name: getattr(change, name) for name in change.model_fields_set}
            )
            view, ground = after.start_view, after.background
            same = has_poster and (view, ground) == (before.start_view, before.background)
            picture = None if view is None or same else await self._render(model_id, view, ground, client)
            if await run_in_threadpool(self._store, model_id, before, after, picture, who):
                return after

    async def inherit(self, model_id: str, new_id: str, who: Caller, client: str) -> None:
        """Show a model as the one that it was made from, with a picture of its own.

        Where that has no start view, the new one begins where its first held-out photo was taken, or its first photo.
        """
        shown = await run_in_threadpool(self.get, model_id)
        change = ChangePresentation.model_validate(shown.model_dump(exclude_defaults=True))
        if shown.start_view is None:
            change.start_view = await run_in_threadpool(self._first_view, new_id)
        await self.save(new_id, change, who, client)

    def _first_view(self, model_id: str) -> CameraSpec | None:
        if self._storage.head(layout.model_file(model_id, "cameras.json")) is None:
            return None
        cameras = self._models.get_cameras(model_id).cameras
        first = next(
            (camera for camera in cameras if camera.split == "test"), cameras[0] if cameras else None
        )
        return None if first is None else first.camera

    def _known(self, model_id: str) -> tuple[Presentation, bool]:
        """Return what is stored, and whether the model has a picture from its start view. Raises problems."""
        self._models.check(model_id)
        try:
            known = self._read(model_id)
        except UnreadableRecord as error:
            raise ProblemError(
                "model_corrupt",
                f"What was saved of how the model {model_id} is shown cannot be read: {error}.",
                advice="Run the version of the server that saved it, or a later one.",
            ) from error
        return known, self._storage.exists(layout.model_file(model_id, POSTER))

    async def _render(self, model_id: str, view: CameraSpec, background: str, client: str) -> bytes:
        """Return the picture of a model from its start view, a JPEG."""
        width = max(1, round(view.width * POSTER_SIDE / max(view.width, view.height)))
        body = RenderRequest.model_validate(
            {
                "camera": view.scaled_to(width),
                "format": Format.jpeg,
                "quality": POSTER_QUALITY,
                "background": background,
            }
        )
        content, headers = body.model_dump_json(exclude_none=True), {rendering.CLIENT_HEADER: client}
        answer = await post(self._renderer, rendering.render_path(model_id), content, headers, self._seconds)
        try:
            picture = await answer.aread()
        except httpx.TransportError as error:
            raise ProblemError(
                "renderer_unavailable",
                f"The renderer ended while it sent the picture from the start view ({type(error).__name__}).",
                advice="Nothing was changed. Try again in a few seconds.",
            ) from error
        finally:
            await answer.aclose()
        if answer.status_code != 200:
            problem = Problem.model_validate_json(picture)
            raise ProblemError(problem.code, problem.detail, advice=problem.advice, facts=problem.facts)
        return picture

    def _store(
        self, model_id: str, before: Presentation, after: Presentation, picture: bytes | None, who: Caller
    ) -> bool:
        """Store a change; return False if another request has changed the record since it was read."""
        fields = after.model_dump(mode="json", exclude_none=True, exclude_defaults=True) | {"format": FORMAT}
        record = json.dumps(fields, indent=1).encode()
        poster = layout.model_file(model_id, POSTER)
        owner = self._models.get_owner(model_id) or DEFAULT_OWNER
        with exclusive(self._connection, "presentation", model_id):
            if self._known(model_id)[0] != before:
                return False
            size = len(record) + len(picture or b"")
            with self._quota.room(who, owner, model_id, size) as room:
                replaced = [layout.presentation(model_id), *([poster] if picture else [])]
                old = sum(entry.size for path in replaced if (entry := self._storage.head(path)) is not None)
                room.stored = max(0, size - old)
                # The picture first: a record without one would let pages begin with a picture from elsewhere.
                if picture is not None:
                    self._storage.put(poster, picture)
                self._storage.put(layout.presentation(model_id), record)
            if after.start_view is None:
                self._storage.delete(poster)
        self._models.lists.forget("models", model_id)  # the files of the model have changed
        if not self._storage.exists(layout.job_record(model_id)):  # it was deleted meanwhile
            for path in (layout.presentation(model_id), poster):
                self._storage.delete(path)
            raise model_not_found(model_id)
        return True

    def _read(self, model_id: str) -> Presentation:
        """Return what is stored. Raises UnreadableRecord for a record that this version cannot read."""
        path = layout.presentation(model_id)
        validate: Callable[[object], Presentation] = Presentation.model_validate
        try:
            record = json.loads(self._storage.get(path))
            check_format(record)
            known, left_out = keep_readable(validate, record)
        except FileNotFoundError:
            return Presentation()
        except (ValidationError, ValueError, TypeError, AttributeError) as error:
            raise UnreadableRecord(f"{path}: {reason(error)}") from error
        if left_out:
            warn(path, f"left out: {'; '.join(left_out)}")
        return known
