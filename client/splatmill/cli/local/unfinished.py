"""What `splatmill train` keeps of a training on this machine until it has succeeded, and how it resumes it.

    DIR/.splatmill/training.json     which photos and options belong to which capture and job
    DIR/.splatmill/...               the data folder of the embedded service

The same photos with the same options go on with their job. Other options begin a new job on the same capture, so that
its cameras are used again. Photos that were changed or removed begin a new capture.
"""

import hashlib
import json
import shutil
import time
import unicodedata
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatmill.errors import Conflict, NotFound, ServiceFailed
from splatmill.files import atomic_write
from splatmill.schema import Capture, Role, TrainOptions, format_bytes
from splatmill.transfer.local_capture import LocalFile

if TYPE_CHECKING:
    from splatmill.sdk.client import Client, JobHandle

RECORD = "training.json"
FORMAT = 1
"""Version of the format of the record."""

_POLL_SECONDS = 0.2


@dataclass
class Training:
    """A training that has begun.

    files: digest of the roles, names and contents of its files.
    options: the options that were given.
    capture: id of the capture.
    job: id of the job.
    """

    files: str
    options: dict[str, Any]
    capture: str
    job: str


@dataclass
class Unfinished:
    """The trainings in a data folder, all of the photos at one path, and what a command wants to train.

    data: the data folder.
    path: the photos, absolute.
    digests: SHA-256 of each file of the command by role and name.
    options: the options that were given to the command.
    trainings: those that earlier commands began, oldest first.
    """

    data: Path
    path: str
    digests: dict[tuple[Role, str], str]
    options: dict[str, Any]
    trainings: list[Training] = field(default_factory=list)

    @classmethod
    def open(
        cls, data: Path, path: Path, files: Sequence[LocalFile], options: TrainOptions, *, fresh: bool
    ) -> "Unfinished":
        """Read what the folder `data` holds of earlier commands, and create it if it does not exist.

        With `fresh`, or without a record, the folder is emptied first. Raises ServiceFailed if it holds a training of
        the photos at another path, or a record that cannot be read.
        """
        record = data / RECORD
        requested = cls(
            data,
            str(path.expanduser().resolve()),
            _digests(files),
            options.model_dump(mode="json", exclude_unset=True),
        )
        if fresh or not record.is_file():
            shutil.rmtree(data, ignore_errors=True)
            data.mkdir(mode=0o700, parents=True, exist_ok=True)
            return requested
        try:
            stored = json.loads(record.read_text())
            if stored["format"] > FORMAT:
                raise ValueError(f"it has format {stored['format']}, and this version reads {FORMAT}")
            path_before = str(stored["path"])
            requested.trainings = [Training(**entry) for entry in stored["trainings"]]
        except (ValueError, KeyError, TypeError) as error:
            raise ServiceFailed(
                f"The unfinished training in {data} cannot be read: {RECORD}: {error}.",
                "Use the version of splatmill that wrote it, or discard the training with --fresh.",
            ) from error
        if path_before != requested.path:
            raise ServiceFailed(
                f"{data} holds an unfinished training of other photos, {path_before} ({size_text(data)}).",
                "Choose another folder with -o, or discard that training with --fresh.",
            )
        return requested

    def stop_others(self, client: "Client") -> None:
        """Cancel the jobs of other files or options: else the service would continue them when it starts."""
        for training in self.trainings:
            if training is not self._same():
                _end(client, training.job)

    def capture(self, client: "Client") -> Capture | None:
        """Return the newest stored capture that holds none but the files of this command, perhaps not all of them."""
        for capture_id in dict.fromkeys(training.capture for training in reversed(self.trainings)):
            try:
                capture = client.capture(capture_id)
            except NotFound:
                continue
            if all(self.digests.get((file.role, file.name)) == file.sha256 for file in capture.files):
                return capture
        return None

    def job(self, client: "Client") -> "JobHandle | None":
        """Return the job of the same files and options, restarted if it has ended without a model; None without one."""
        same = self._same()
        if same is None:
            return None
        try:
            job = client.job(same.job)
        except NotFound:
            return None  # Redis may lose its last second when the machine fails
        while job.job.cancel_requested and not job.state.final:
            time.sleep(_POLL_SECONDS)
            job.refresh()
        if job.state.final and job.job.model is None:
            job.restart()
        return job

    def remember(self, capture: str, job: str) -> None:
        """Record the job that this command has begun."""
        self.trainings = [training for training in self.trainings if training is not self._same()]
        self.trainings.append(Training(self._files(), self.options, capture, job))
        document = {
            "format": FORMAT,
            "path": self.path,
            "trainings": [asdict(training) for training in self.trainings],
        }
        atomic_write(self.data / RECORD, json.dumps(document, indent=1), sync=True)

    def _same(self) -> Training | None:
        requested = (self._files(), self.options)
        return next((known for known in self.trainings if (known.files, known.options) == requested), None)

    def _files(self) -> str:
        lines = sorted(f"{role.value}/{name}\0{digest}" for (role, name), digest in self.digests.items())
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def size_text(folder: Path) -> str:
    """Return the size of the files in a folder as text."""
    return format_bytes(sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file()))


def _digests(files: Sequence[LocalFile]) -> dict[tuple[Role, str], str]:
    # The server stores names in this form of Unicode (see `safe_name`).
    digests = {}
    for file in files:
        with suppress(OSError):  # the upload leaves it out, or ends with this error
            digests[file.role, unicodedata.normalize("NFC", file.name)] = _sha256(file.path)
    return digests


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _end(client: "Client", job_id: str) -> None:
    """Cancel a job, if it has not ended, and wait until it has."""
    try:
        job = client.job(job_id)
        if not job.state.final:
            job.cancel()
    except (NotFound, Conflict):
        return  # it is gone, or has just ended
    while not job.refresh().state.final:
        time.sleep(_POLL_SECONDS)
