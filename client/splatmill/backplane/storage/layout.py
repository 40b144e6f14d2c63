"""The layout of storage: pure functions from ids to paths.

captures/{id}/capture.json                  record of the capture
captures/{id}/files/{role}/{name}           uploaded file; role is images, masks or poses, name a `safe_name`
captures/{id}/sha256/{role}/{name}          hex digest of that file; written first, so that it claims the name
captures/{id}/manifest.json                 the digests of all files, in one file; it can be made again
captures/{id}/incoming/{token}              upload in progress; renamed into files/ when complete
captures/{id}/uploads/{upload}/record.json  upload that arrives in several requests: what it will be
captures/{id}/uploads/{upload}/stored.json  in place of record.json, once it is complete: the file that it became
captures/{id}/uploads/{upload}/part         its bytes so far, in a local folder
captures/{id}/uploads/{upload}/blocks/...   its bytes so far, in a bucket: objects named by their offset
captures/{id}/imports/{import}.json         record of a file that the server fetches from an address
captures/{id}/sfm/...                       reconstruction, shared by the jobs of the capture
imports/{capture}.{import}                  mark of an import that has not ended
orbits/{owner}.{model}.{orbit}              mark of an orbit video that has not ended; owner is a digest
meshes/{owner}.{model}.{mesh}               mark of a mesh that has not ended
webhooks/{id}/webhook.json                  record of a webhook, with its secrets
webhooks/{id}/deliveries/{delivery}.json    one event for this webhook, and the attempts to deliver it
due/{time}.{webhook}.{delivery}             mark of a delivery that is pending: Unix time of its next attempt
watched/{job}.json                          row of an unfinished job, from which it is restored if Redis is lost
jobs/{id}/work/...                          checkpoints and other files from which another machine can resume
jobs/{id}/log.jsonl                         the job as it ended, then the lines of its log
jobs/{id}/curve.jsonl                       the curve of the job, a row per line; written when it has ended
jobs/{id}/cameras.json                      cameras and points as structure from motion placed them
models/{id}/{file}                          model.ply, report.json, report.png, report.html, cameras.json, ...
models/{id}/held_out/{n}.webp               held-out photo, as the renderings were compared with it
models/{id}/time_lapse/{n}.ply              snapshot of the training, a compressed .ply
models/{id}/formats/{format}                the model in another file format
models/{id}/formats/{format}.json           what the conversion cost and lost; written last
models/{id}/orbits/{orbit}/orbit.json       record of an orbit video, and how many of its frames are stored
models/{id}/orbits/{orbit}/frames/{n}.mp4   some of its frames, from the n-th on, until the video is whole
models/{id}/orbits/{orbit}/orbit.mp4        the video
models/{id}/meshes/{mesh}/mesh.json         record of a mesh
models/{id}/meshes/{mesh}/mesh              the mesh, in the format of its request
models/{id}/presentation.json               how the model is shown to people: start view, measurements, annotations
models/{id}/poster.jpg                      its picture from the start view that was chosen for it
models/{id}/job.json                        record of the ended job; written last: a model exists once it does
names/{job}.json                            name, tags and star that a job was given later, and its model with it
bin/{kind}.{id}.json                        record in the bin, kind job or capture: who it belongs to, and when it goes
keys/{id}.json                              a key of the API: its owner, scopes, limits, and the digests of its secrets
keys/{id}.revoked                           the key was revoked; it counts more than the record beside it
shares/{model}/{share}.json                 a link to a model: when it ends, and the digest of its token

The id of a model is that of the job that made it.
"""

import re
from typing import Literal

from splatmill.schema import HELD_OUT, POSTER, TIME_LAPSE, Role
from splatmill.schema.ids import ID

KeptKind = Literal["orbits", "meshes"]
"""The kinds of what is made of a model in the background and kept with it: the names of their folders."""

_RECORDS: dict[KeptKind, str] = {"orbits": "orbit.json", "meshes": "mesh.json"}

MODEL_FILES = {
    "model.ply": "application/octet-stream",
    "report.json": "application/json",
    "report.png": "image/png",
    "report.html": "text/html; charset=utf-8",
    "cameras.json": "application/json",
    "cameras.zip": "application/zip",
    "frame.json": "application/json",
    "job.json": "application/json",
    "preview.jpg": "image/jpeg",
    POSTER: "image/jpeg",
    "progress.mp4": "video/mp4",
}
"""The files that a model may have, with their media types."""

MODEL_FOLDERS = {
    HELD_OUT: (re.compile(r"[0-9]{3,6}\.webp", re.ASCII), "image/webp"),
    TIME_LAPSE: (re.compile(r"[0-9]{3,6}\.ply", re.ASCII), "application/octet-stream"),
}
"""The folders that a model may have: the names of the files in them, and their media type."""


MANIFEST = "manifest.json"
"""The name of the file with the digests of all files of a capture."""


def model_media_type(name: str) -> str | None:
    """Return the media type of a file that a model may have, as "model.ply" or "held_out/000.webp"; None for any other
    name, which must not become part of a path."""
    folder, slash, inside = name.rpartition("/")
    if not slash:
        return MODEL_FILES.get(name)
    names, media_type = MODEL_FOLDERS.get(folder, (None, ""))
    return media_type if names is not None and names.fullmatch(inside) else None


def is_id(text: str) -> bool:
    """Return whether `text` has the form of an id. No other text may become part of a path."""
    return ID.fullmatch(text) is not None


def folder_of(path: str) -> tuple[str, str, str] | None:
    """Return the kind of the folder that holds a path ("captures", "jobs" or "models"), the id in its name and the
    rest of the path, or None for a path of another kind."""
    kind, _, rest = path.partition("/")
    record_id, _, inside = rest.partition("/")
    return (kind, record_id, inside) if kind in ("captures", "jobs", "models") and is_id(record_id) else None


def is_derived(kind: str, inside: str) -> bool:
    """Return whether a path inside of a folder can be made again: a capture's reconstruction and manifest, a job's work
    files, or a model's conversions to other formats, orbit videos and meshes."""
    return (kind, inside.partition("/")[0]) in (
        ("captures", "sfm"),
        ("captures", MANIFEST),
        ("jobs", "work"),
        ("models", "formats"),
        ("models", "orbits"),
        ("models", "meshes"),
    )


def digest_of(path: str) -> tuple[str, str] | None:
    """Return role and name of the file whose digest lies at a path, or None for a path of another kind."""
    parts = path.split("/", 4)
    return (
        (parts[3], parts[4])
        if len(parts) == 5 and parts[2] == "sha256" and parts[3] in Role.__members__
        else None
    )


def captures() -> str:
    return "captures"


def capture(capture_id: str) -> str:
    return f"captures/{capture_id}"


def capture_record(capture_id: str) -> str:
    return f"captures/{capture_id}/capture.json"


def capture_files(capture_id: str, role: Role | None = None) -> str:
    """Return the folder of all uploaded files, or of those of one role."""
    folder = f"captures/{capture_id}/files"
    return folder if role is None else f"{folder}/{role}"


def capture_file(capture_id: str, role: Role, name: str) -> str:
    return f"captures/{capture_id}/files/{role}/{name}"


def capture_digest(capture_id: str, role: Role, name: str) -> str:
    return f"captures/{capture_id}/sha256/{role}/{name}"


def capture_manifest(capture_id: str) -> str:
    return f"captures/{capture_id}/{MANIFEST}"


def capture_incoming(capture_id: str, token: str | None = None) -> str:
    """Return the folder of uploads in progress, or the path of one of them."""
    folder = f"captures/{capture_id}/incoming"
    return folder if token is None else f"{folder}/{token}"


def capture_uploads(capture_id: str) -> str:
    """Return the folder of the uploads that arrive in several requests."""
    return f"captures/{capture_id}/uploads"


def upload(capture_id: str, upload_id: str) -> str:
    return f"captures/{capture_id}/uploads/{upload_id}"


def upload_record(capture_id: str, upload_id: str) -> str:
    return f"captures/{capture_id}/uploads/{upload_id}/record.json"


def upload_stored(capture_id: str, upload_id: str) -> str:
    """Return the path of the record of an upload that is complete."""
    return f"captures/{capture_id}/uploads/{upload_id}/stored.json"


def upload_part(capture_id: str, upload_id: str) -> str:
    return f"captures/{capture_id}/uploads/{upload_id}/part"


def upload_blocks(capture_id: str, upload_id: str) -> str:
    return f"captures/{capture_id}/uploads/{upload_id}/blocks"


def capture_imports(capture_id: str) -> str:
    """Return the folder of the records of a capture's imports."""
    return f"captures/{capture_id}/imports"


def import_record(capture_id: str, import_id: str) -> str:
    return f"captures/{capture_id}/imports/{import_id}.json"


def unfinished_imports() -> str:
    """Return the folder of the marks of all imports that have not ended."""
    return "imports"


def unfinished_import(capture_id: str, import_id: str) -> str:
    return f"imports/{capture_id}.{import_id}"


def capture_sfm(capture_id: str) -> str:
    return f"captures/{capture_id}/sfm"


def jobs() -> str:
    return "jobs"


def job(job_id: str) -> str:
    return f"jobs/{job_id}"


def job_work(job_id: str) -> str:
    return f"jobs/{job_id}/work"


def job_units(job_id: str) -> str:
    """Return the folder of the units of a job that is trained in tiles: its plan, and what its units have made."""
    return f"{job_work(job_id)}/units"


def job_log(job_id: str) -> str:
    """Return the path of the log of a job that has ended. Only the server writes it."""
    return f"jobs/{job_id}/log.jsonl"


def job_curve(job_id: str) -> str:
    """Return the path of the curve of a job that has ended. Only the server writes it."""
    return f"jobs/{job_id}/curve.jsonl"


def job_cameras(job_id: str) -> str:
    """Return the path of a job's cameras and points, a `Placement`. Only the worker writes it."""
    return f"jobs/{job_id}/cameras.json"


def labels() -> str:
    """Return the folder of the names, tags and stars that jobs were given later."""
    return "names"


def job_labels(job_id: str) -> str:
    """Return the path of the name, the tags and the star that a job was given later. Only the server writes it."""
    return f"names/{job_id}.json"


def bin_folder() -> str:
    """Return the folder of what is in the bin."""
    return "bin"


def binned(kind: str, record_id: str) -> str:
    """Return the path of the mark that a job or a capture is in the bin."""
    return f"bin/{kind}.{record_id}.json"


def models() -> str:
    return "models"


def model(model_id: str) -> str:
    return f"models/{model_id}"


def model_file(model_id: str, name: str) -> str:
    return f"models/{model_id}/{name}"


def presentation(model_id: str) -> str:
    """Return the path of how a model is shown to people, a `Presentation`. Only the server writes it."""
    return f"models/{model_id}/presentation.json"


def conversion(model_id: str, key: str) -> str:
    """Return the path of a model in the format with this key."""
    return f"models/{model_id}/formats/{key}"


def conversion_record(model_id: str, key: str) -> str:
    """Return the path of the record of a conversion; the file is whole once it exists."""
    return f"models/{model_id}/formats/{key}.json"


def kept_of(model_id: str, kind: KeptKind) -> str:
    """Return the folder of what is made of a model in the background and kept with it: of one kind."""
    return f"models/{model_id}/{kind}"


def kept(model_id: str, kind: KeptKind, kept_id: str) -> str:
    return f"models/{model_id}/{kind}/{kept_id}"


def kept_record(model_id: str, kind: KeptKind, kept_id: str) -> str:
    """Return the path of the record of an orbit video or a mesh. Only the server writes it."""
    return f"models/{model_id}/{kind}/{kept_id}/{_RECORDS[kind]}"


def unfinished_kept(kind: KeptKind) -> str:
    """Return the folder of the marks of all orbit videos, or all meshes, that have not ended."""
    return kind


def unfinished_mark(kind: KeptKind, owner: str, model_id: str, kept_id: str) -> str:
    """Return the path of the mark of one that has not ended; `owner` is a digest, since owners may have any name."""
    return f"{kind}/{owner}.{model_id}.{kept_id}"


def orbit_video(model_id: str, orbit_id: str) -> str:
    return f"models/{model_id}/orbits/{orbit_id}/orbit.mp4"


def orbit_frames(model_id: str, orbit_id: str, first: int | None = None) -> str:
    """Return the folder of the frames of an unfinished orbit video, or the path of those from one frame on."""
    folder = f"models/{model_id}/orbits/{orbit_id}/frames"
    return folder if first is None else f"{folder}/{first:06d}.mp4"


def mesh_file(model_id: str, mesh_id: str) -> str:
    return f"models/{model_id}/meshes/{mesh_id}/mesh"


def job_record(job_id: str) -> str:
    """Return the path of `job.json`, from which a finished job is read when Redis has lost it."""
    return f"models/{job_id}/job.json"


def shares_of(model_id: str) -> str:
    """Return the folder of the links to a model."""
    return f"shares/{model_id}"


def share_record(model_id: str, share_id: str) -> str:
    return f"shares/{model_id}/{share_id}.json"


def keys() -> str:
    return "keys"


def key_record(key_id: str) -> str:
    return f"keys/{key_id}.json"


def key_revocation(key_id: str) -> str:
    return f"keys/{key_id}.revoked"


def webhooks() -> str:
    return "webhooks"


def webhook(webhook_id: str) -> str:
    return f"webhooks/{webhook_id}"


def webhook_record(webhook_id: str) -> str:
    return f"webhooks/{webhook_id}/webhook.json"


def deliveries(webhook_id: str) -> str:
    """Return the folder of the deliveries of a webhook."""
    return f"webhooks/{webhook_id}/deliveries"


def delivery_record(webhook_id: str, delivery_id: str) -> str:
    return f"webhooks/{webhook_id}/deliveries/{delivery_id}.json"


def due_deliveries() -> str:
    """Return the folder of the marks of all pending deliveries."""
    return "due"


def due_delivery(seconds: int, webhook_id: str, delivery_id: str) -> str:
    """Return the path of the mark of a pending delivery, whose next attempt is due at a Unix time."""
    return f"due/{seconds:012d}.{webhook_id}.{delivery_id}"


def unfinished_jobs() -> str:
    """Return the folder of the rows of unfinished jobs."""
    return "watched"


def unfinished_job(job_id: str) -> str:
    """Return the path of the row of an unfinished job."""
    return f"watched/{job_id}.json"
