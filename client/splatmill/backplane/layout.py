"""Where things lie in storage: pure functions from ids to paths.

captures/{id}/capture.json                  the capture's record
captures/{id}/files/{role}/{name}           what was uploaded; role is images, masks or poses, name is safe_name's
captures/{id}/sha256/{role}/{name}          hex digest of that file; written first, so it decides who owns a name
captures/{id}/incoming/{token}              an upload under way; renamed into files/ when whole
captures/{id}/sfm/...                       reconstruction shared by the jobs of this capture
jobs/{id}/work/...                          checkpoints and state that another machine may pick up
models/{id}/{file}                          model.ply, report.json, report.png, report.html, cameras.json, ...
models/{id}/job.json                        the job as it ended; its presence is what makes a model exist

A model's id is the id of the job that made it.
"""

from splatmill.schema import Role
from splatmill.schema.ids import ID

MODEL_FILES = {
    "model.ply": "application/octet-stream",
    "report.json": "application/json",
    "report.png": "image/png",
    "report.html": "text/html; charset=utf-8",
    "cameras.json": "application/json",
    "job.json": "application/json",
    "preview.jpg": "image/jpeg",
    "progress.mp4": "video/mp4",
}
"""Names a model may hold, with the media type each is served under."""


def is_id(text: str) -> bool:
    """Whether `text` has the shape of a capture or job id; anything else must never reach a path."""
    return ID.fullmatch(text) is not None


def captures() -> str:
    return "captures"


def capture(capture_id: str) -> str:
    return f"captures/{capture_id}"


def capture_record(capture_id: str) -> str:
    return f"captures/{capture_id}/capture.json"


def capture_files(capture_id: str, role: Role | None = None) -> str:
    """The folder of all uploads, or of those of one role: `images`, `masks` and `poses` lie side by side in it."""
    folder = f"captures/{capture_id}/files"
    return folder if role is None else f"{folder}/{role}"


def capture_file(capture_id: str, role: Role, name: str) -> str:
    return f"captures/{capture_id}/files/{role}/{name}"


def capture_digest(capture_id: str, role: Role, name: str) -> str:
    return f"captures/{capture_id}/sha256/{role}/{name}"


def capture_incoming(capture_id: str, token: str | None = None) -> str:
    """The folder of uploads under way, or one of them."""
    folder = f"captures/{capture_id}/incoming"
    return folder if token is None else f"{folder}/{token}"


def capture_sfm(capture_id: str) -> str:
    return f"captures/{capture_id}/sfm"


def job(job_id: str) -> str:
    return f"jobs/{job_id}"


def job_work(job_id: str) -> str:
    return f"jobs/{job_id}/work"


def models() -> str:
    return "models"


def model(model_id: str) -> str:
    return f"models/{model_id}"


def model_file(model_id: str, name: str) -> str:
    return f"models/{model_id}/{name}"


def job_record(job_id: str) -> str:
    """`job.json` beside the model: the truth about a finished job when Redis is gone."""
    return f"models/{job_id}/job.json"
