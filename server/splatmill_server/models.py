"""Finished models: their files, their cameras and their lists.

They are read from storage, so each stays available while Redis is away; only lists need Redis.
"""

import json
import re
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import Field, ValidationError

from splatmill.backplane import lists
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import UnreadableRecord, warn
from splatmill.backplane.storage.storage import Entry, Storage
from splatmill.schema import (
    DEFAULT_OWNER,
    BinKind,
    ChangeLabels,
    Job,
    JobState,
    ListOrder,
    Model,
    ModelCameras,
    ModelFile,
    ModelPage,
    Report,
    Response,
    StoredKind,
)
from splatmill_server.access.caller import Caller
from splatmill_server.base.filters import Filter
from splatmill_server.base.lists import Ended, Lists, each
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.root_path import address
from splatmill_server.jobs import labels as job_labels
from splatmill_server.jobs.ranking import rank, ranked_page
from splatmill_server.jobs.records import Jobs, read_model_record, read_record

_HEADER_BYTES = 8192
_VERTICES = re.compile(rb"^element vertex (\d+)\s*$", re.MULTILINE)
_REST = re.compile(rb"^property float f_rest_\d+\s*$", re.MULTILINE)
_SHA256 = re.compile(r"[0-9a-f]{64}")
_DEGREE = {0: 0, 9: 1, 24: 2, 45: 3}
"""Degree of the spherical harmonics by number of `f_rest` properties, which is 3 ((degree + 1)^2 - 1)."""


_LISTED_TOGETHER = 500


class _Labelled(Response):
    """What lists keep of a model before it is first asked for."""

    name: str | None
    tags: list[str] = Field(default_factory=list)
    favourite: bool = False


class Models:
    """All operations on models. A model exists if its `job.json` does, which the worker writes last."""

    def __init__(self, storage: Storage, jobs: Jobs, listed: Lists) -> None:
        self.storage = storage
        self.jobs = jobs
        self.lists = listed

    def check(self, model_id: str) -> None:
        """Raise a problem if there is no such model (404) or if its job has not ended (409)."""
        if layout.is_id(model_id) and self.storage.exists(layout.job_record(model_id)):
            return
        job = None
        try:
            job = self.jobs.get(model_id)
        except ProblemError as error:
            if error.problem.code != "job_not_found":
                raise
        if job is not None and not job.state.final:
            raise ProblemError(
                "model_not_ready",
                f"The model is not finished; the state of its job is {job.state.value}.",
                advice=f"Follow its progress at /v1/jobs/{job.id}/events, and try again when the job has "
                f"ended.",
                facts={"job": job.id, "state": job.state.value},
            )
        if job is not None and job.state is not JobState.succeeded:
            raise ProblemError(
                "model_not_found",
                f"The job {job.id} ended as {job.state.value}, so it has no model.",
                facts={"job": job.id, "state": job.state.value},
            )
        raise model_not_found(model_id)

    def check_visible(self, who: Caller, model_id: str) -> None:
        """Raise a 404 problem if another owner has the model, or the job that is to make it."""
        if not who.admin and not who.may_see(self.get_owner(model_id)):
            raise model_not_found(model_id)

    def get_owner(self, model_id: str) -> str | None:
        """Return the owner of a model, or of the job that is to make it, or None if it cannot be read.

        The record in storage comes first, so that models can be read while Redis cannot be reached.
        """
        if not layout.is_id(model_id):
            return None
        try:
            return read_record(self.storage, model_id).owner
        except (FileNotFoundError, UnreadableRecord):
            return self.jobs.get_owner(model_id)

    def get_name(self, model_id: str) -> str | None:
        """Return the name of a model, or None if it has none that can be read."""
        try:
            return read_record(self.storage, model_id).name
        except (FileNotFoundError, UnreadableRecord):
            return None

    def get(self, model_id: str) -> Model:
        """Return a model with its files. Raises 404 and 409 problems, and 500 if its files cannot be read."""
        self.check(model_id)
        folder = layout.model(model_id) + "/"
        files = {
            entry.path.removeprefix(folder): entry for entry in self.storage.entries(layout.model(model_id))
        }
        try:
            job, record = read_model_record(self.storage, model_id)
            digests = _digests(record)
            gaussians, degree = self._header(model_id, files["model.ply"])
        except (KeyError, ValueError, FileNotFoundError) as error:
            raise ProblemError(
                "model_corrupt",
                f"The stored model {model_id} cannot be read: {error}.",
                advice=f"Restart its job with POST /v1/jobs/{model_id}/restart.",
            ) from error
        psnr, ssim = self._quality(model_id)
        return Model(
            id=model_id,
            job=model_id,
            name=job.name,
            tags=job.tags,
            favourite=job.favourite,
            owner=job.owner,
            created_at=job.finished_at or files["job.json"].modified,
            gaussians=gaussians,
            bytes=files["model.ply"].size,
            sh_degree=degree,
            psnr=psnr,
            ssim=ssim,
            files=[
                ModelFile(
                    name=name,
                    size=entry.size,
                    sha256=digests.get(name),
                    media_type=media_type,
                )
                for name, entry in sorted(files.items())
                if (media_type := layout.model_media_type(name)) is not None
            ],
            links=_links(model_id),
        )

    def label(self, model_id: str, change: ChangeLabels) -> Model:
        """Change the labels of a model, and of its job with it. Raises 404 and 409 problems."""
        self.check(model_id)
        self.jobs.label(model_id, change)
        return self.get(model_id)

    def list(
        self,
        cursor: str | None,
        limit: int,
        only: Filter | None = None,
        order: ListOrder = ListOrder.newest,
    ) -> ModelPage:
        """Return a page of the models that `only` admits. Raises the problems of `Lists.page` and `ranked_page`."""
        only = only or Filter()
        names = [lists.name("models", owner=only.owner)]

        def read(model_ids: Sequence[str]) -> dict[str, Model]:
            return self._listed(model_ids, only)

        def ranks(models: Mapping[str, Model]) -> dict[str, Any]:
            return {name: rank(order, model.name, model) for name, model in models.items()}

        if order is not ListOrder.newest:
            models, following = ranked_page(self.lists, names, cursor, limit, order, read, ranks)
        else:
            models, following = self.lists.page(names, cursor, limit, read, narrowed=only.by_labels)
        return ModelPage(models=models, cursor=following)

    def finished(self, model_ids: Sequence[str]) -> dict[str, Model]:
        """Return those of these models that are finished and not in the bin, by id, without those that are corrupt."""
        return self._listed(model_ids, Filter())

    def _listed(self, model_ids: Sequence[str], only: Filter) -> dict[str, Model]:
        """Return those of these models that `only` admits, by id. What was read of one is kept for lists."""
        kept = self.lists.records("models", model_ids, BinKind.job)
        known = {name: _kept(record) for name, record in kept.items()}
        asked = [
            name
            for name, record in known.items()
            if not isinstance(record, Model) and (record is None or _admits(only, only.owner or "", record))
        ]
        read = dict(zip(asked, each(self._get_or_none, asked), strict=True))
        self.lists.keep(
            "models", {name: _keep(record) for name, record in read.items() if record is not None}
        )
        models = {name: record for name, record in (known | read).items() if isinstance(record, Model)}
        return {
            name: record.model_copy(update={"links": _links(name)})
            for name, record in models.items()
            if _admits(only, record.owner or DEFAULT_OWNER, record)
        }

    def _get_or_none(self, model_id: str) -> Model | None:
        """Return a model, or None for one that was deleted or is corrupt, which must not hide the others."""
        try:
            return self.get(model_id)
        except ProblemError as error:
            if error.problem.code == "model_corrupt":
                warn(f"model {model_id} is not listed", error.problem.detail)
            return None

    def list_new(self, model_id: str) -> None:
        """List a model that was just stored."""
        record = read_record(self.storage, model_id)
        moment = record.finished_at or record.created_at
        lists.add_model(self.lists.connection, model_id, moment, record.owner or DEFAULT_OWNER)

    def list_missing(self, model_ids: Sequence[str]) -> int:
        """List those of these models that no list holds, as one that was copied into storage; return their number."""
        missing = self.lists.missing("models", model_ids)
        records = [record for record in each(self._record, missing) if record is not None]
        for record in records:
            moment = record.finished_at or record.created_at
            lists.add_model(self.lists.connection, record.id, moment, record.owner or DEFAULT_OWNER)
        return len(records)

    def make_lists(self, succeeded: Mapping[str, Ended]) -> int:
        """List all models in storage, and return their number. Their files are read when they are first asked for.

        succeeded: jobs that have, whose models need no reading; the record of any other is read.
        """
        connection, count = self.lists.connection, 0
        lists.clear(connection, "models")
        ids = [name for name in self.storage.children(layout.models()) if layout.is_id(name)]
        unread = any(model_id not in succeeded for model_id in ids)
        labelled = job_labels.labelled(self.storage) if unread else frozenset()
        for start in range(0, len(ids), _LISTED_TOGETHER):
            batch = ids[start : start + _LISTED_TOGETHER]
            ended = {model_id: succeeded[model_id] for model_id in batch if model_id in succeeded}
            others = [model_id for model_id in batch if model_id not in succeeded]
            ended |= {
                record.id: _ended(record)
                for record in each(lambda name: self._record(name, labelled), others)
                if record is not None
            }
            added = lists.Additions()
            for model_id, record in ended.items():
                lists.add(added, "models", model_id, record.moment, record.owner)
            with connection.pipeline() as pipe:
                added.send(pipe)
                pipe.execute()
            kept = {
                model_id: _Labelled(name=record.name, tags=[*record.tags], favourite=record.favourite)
                for model_id, record in ended.items()
            }
            self.lists.keep("models", {model_id: _keep(record) for model_id, record in kept.items()})
            for model_id in self.lists.deleted(StoredKind.model, list(ended)):
                if not self.storage.exists(layout.job_record(model_id)):
                    lists.remove_model(connection, model_id, ended[model_id].owner)
            count += len(ended)
        return count

    def _record(self, model_id: str, labelled: frozenset[str] | None = None) -> Job | None:
        try:
            return read_record(self.storage, model_id, labelled).model_copy(update={"id": model_id})
        except FileNotFoundError:
            return None
        except UnreadableRecord as error:
            warn(f"model {model_id} is not listed", str(error))
            return None

    def get_file(self, model_id: str, name: str) -> Entry:
        """Return the entry of a file of a model. Raises 404 and 409 problems."""
        self.check(model_id)
        known = layout.model_media_type(name) is not None
        entry = self.storage.head(layout.model_file(model_id, name)) if known else None
        if entry is None:
            raise ProblemError(
                "file_not_found",
                f"The model {model_id} has no file {name[:80]!r}.",
                advice=f"The files of a model are: {', '.join(sorted(layout.MODEL_FILES))}, and those that "
                f"GET /v1/models/{model_id} lists in the folders {' and '.join(layout.MODEL_FOLDERS)}.",
            )
        return entry

    def get_cameras(self, model_id: str) -> ModelCameras:
        """Return the cameras of the capture in the coordinates of the model."""
        self.get_file(model_id, "cameras.json")
        stored = self.storage.get(layout.model_file(model_id, "cameras.json"))
        try:
            return ModelCameras.model_validate_json(stored)
        except ValidationError as error:
            raise ProblemError(
                "model_corrupt", f"The file cameras.json of the model {model_id} cannot be read: {error}."
            ) from error

    def antialias(self, model_id: str) -> bool:
        """Return whether the model was trained with antialiasing, as the plan in its report says."""
        try:
            plan = Report.model_validate_json(
                self.storage.get(layout.model_file(model_id, "report.json"))
            ).plan
        except (FileNotFoundError, ValidationError):
            return False
        decided = plan.get("antialias")
        return bool(decided.get("value") if isinstance(decided, dict) else decided)

    def _header(self, model_id: str, entry: Entry) -> tuple[int, int]:
        """Return the number of Gaussians and the degree of the spherical harmonics, from the header of the .ply."""
        end = min(entry.size, _HEADER_BYTES)
        head, marker, _ = self.storage.get(entry.path, 0, end).partition(b"end_header")
        count = _VERTICES.search(head)
        if not marker or count is None:
            raise ValueError(f"model.ply of {model_id} has no valid .ply header")
        return int(count[1]), _DEGREE.get(len(_REST.findall(head)), 0)

    def _quality(self, model_id: str) -> tuple[Any, Any]:
        """Return PSNR (dB) and SSIM of the last measurement; None if no photos were held out."""
        try:
            report = Report.model_validate_json(self.storage.get(layout.model_file(model_id, "report.json")))
        except (FileNotFoundError, ValidationError):
            return None, None
        measured = [point for point in report.curve if point.psnr is not None]
        return (measured[-1].psnr, measured[-1].ssim) if measured else (None, None)


def _digests(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the SHA-256 of the files that a `job.json` names."""
    digests = record.get("sha256")
    digests_by_name = digests.items() if isinstance(digests, dict) else ()
    return {
        name: digest
        for name, digest in digests_by_name
        if isinstance(digest, str) and _SHA256.fullmatch(digest)
    }


def _ended(record: Job) -> Ended:
    """Return what a list of models shows of the record of one."""
    moment = lists.milliseconds(record.finished_at or record.created_at)
    return Ended(moment, record.owner or DEFAULT_OWNER, record.name, record.tags, record.favourite)


def _admits(only: Filter, owner: str, record: Model | _Labelled) -> bool:
    """Return whether a filter admits a model of this owner."""
    return only.admits(owner, record.name, record.tags, record.favourite)


def _links(model_id: str) -> dict[str, str]:
    base = address(f"/v1/models/{model_id}")
    return {
        "self": base,
        "job": address(f"/v1/jobs/{model_id}"),
        "cameras": f"{base}/cameras",
        "render": f"{base}/render",
        "orbit": f"{base}/orbit",
        "orbits": f"{base}/orbits",
        "meshes": f"{base}/meshes",
        "presentation": f"{base}/presentation",
        "formats": f"{base}/formats",
        "html": f"{base}/download/html",
        "ply": f"{base}/files/model.ply",
        "report": f"{base}/files/report.html",
    }


def _keep(record: Model | _Labelled) -> bytes:
    """Return what Redis keeps of a model for lists: digests and names of files, in a third of their bytes."""
    return zlib.compress(record.model_dump_json(exclude={"links"}).encode())


def _kept(stored: bytes | None) -> Model | _Labelled | None:
    """Return what was kept of a model, or None if nothing was that this version reads."""
    if stored is None:
        return None
    fields = json.loads(zlib.decompress(stored))
    try:
        return (Model if "files" in fields else _Labelled).model_validate(fields)
    except ValidationError:
        return None


def model_not_found(model_id: str) -> ProblemError:
    """Return the 404 problem for an id without a model."""
    return ProblemError(
        "model_not_found",
        f"There is no model {model_id[:80]!r}.",
        advice="List the models with GET /v1/models.",
    )
