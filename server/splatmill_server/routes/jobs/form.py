"""`POST /v1/jobs` with a form: uploads photos and starts a job in one request."""

import unicodedata

from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from pydantic_core import from_json
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request

from splatmill.backplane.jobs import events, row
from splatmill.schema import CaptureFile, CreateJob, Job, LogEvent, Role, storable_name
from splatmill_server.access.caller import Caller
from splatmill_server.base.problems import ProblemError
from splatmill_server.captures.records import fingerprints
from splatmill_server.requests.multipart import Part, read_parts
from splatmill_server.service import Service
from splatmill_server.space.quota import bytes_beside

_FIELDS = ("name", "options", "priority")


async def create_from_form(
    service: Service, who: Caller, request: Request, key: str | None
) -> tuple[Job, bool]:
    """Store the files of a form in a new capture and start a job on it; return the job, and whether it is new.

    The files are the parts `images`, `masks` and `poses`; the field `options` is JSON, `name` is text, and `priority` a
    number. A photo or mask whose name is not accepted is stored under another one, which the log of the job names. If
    any part is refused, the capture is deleted.
    """
    await run_in_threadpool(service.quota.check_new, who)
    capture, _ = await run_in_threadpool(lambda: service.captures.create(owner=who.owner))
    kept = False
    try:
        files, fields, renamed = await _receive(service, who, request, capture.id)
        create = _request(capture.id, fields)
        described = create.described(with_capture=False) + "\n".join(fingerprints(files))
        job, new = await run_in_threadpool(
            lambda: service.admission.create(who, create, key=key, body=described)
        )
        kept = job.capture == capture.id
        if new:
            await run_in_threadpool(_log_renamed, service, job.id, renamed)
        return job, new
    finally:
        if not kept:
            await run_in_threadpool(service.deletion.unused_capture, capture)


async def _receive(
    service: Service, who: Caller, request: Request, capture_id: str
) -> tuple[list[CaptureFile], dict[str, str], list[tuple[str, str]]]:
    """The stored files, the fields, and the names of the files that are stored under others, each with the other."""
    files: list[CaptureFile] = []
    renamed: list[tuple[str, str]] = []
    fields: dict[str, str] = {}
    async for part in read_parts(request):
        if part.filename is not None and part.name in Role.__members__:
            name = part.filename if part.name == Role.poses else storable_name(part.filename)
            if name != unicodedata.normalize("NFC", part.filename):
                renamed.append((part.filename, name))
            files.append(await _store(service, who, capture_id, part, name))
        elif part.filename is None and part.name in fields:
            raise ProblemError("invalid_request", f"The form contains the field {part.name!r} twice.")
        elif part.filename is None and part.name in _FIELDS:
            fields[part.name] = await part.text()
        else:
            kind = "file" if part.filename is not None else "field"
            raise ProblemError(
                "invalid_request",
                f"The form contains an unknown {kind}, {part.name[:80]!r}.",
                advice="Send the files as 'images', 'masks' and 'poses', and the fields 'options' "
                "(JSON), 'name' and 'priority'.",
            )
    return files, fields, renamed


def _log_renamed(service: Service, job_id: str, renamed: list[tuple[str, str]]) -> None:
    """Append a warning to the log of a new job for each file that is stored under another name."""
    job_row = row.read(service.redis, job_id) if renamed else None
    if job_row is None:
        return
    for name, stored in renamed:
        message = f"The file name {name[:80]!a} is not accepted; the file is stored as {stored}."
        warning = LogEvent(level="warning", message=message)
        events.append(service.redis, job_id, job_row.generation, 0, warning)


async def _store(service: Service, who: Caller, capture_id: str, part: Part, filename: str) -> CaptureFile:
    if not filename:
        raise ProblemError("name_invalid", f"A file among the {part.name} of the form has no file name.")
    async with service.quota.upload(who, capture_id, None, beside=bytes_beside(filename)) as arrival:
        file, new = await service.captures.save_file(
            capture_id, Role(part.name), filename, arrival.counted(part.chunks)
        )
        arrival.stored = file.size if new else 0
    return file


def _request(capture_id: str, fields: dict[str, str]) -> CreateJob:
    try:
        # Unlike json.loads, from_json refuses deep nesting with a ValueError.
        options = from_json(fields.get("options") or "{}")
    except ValueError as error:
        raise ProblemError(
            "malformed_body",
            f"The field 'options' is not JSON: {error}.",
            advice='Send a JSON object such as {"steps": 1000}.',
        ) from error
    body = {"capture": capture_id, "options": options, "name": fields.get("name") or None}
    body |= {"priority": fields["priority"]} if "priority" in fields else {}
    try:
        return CreateJob.model_validate(body)
    except ValidationError as error:
        raise RequestValidationError(error.errors()) from error
