"""Cameras once recovered serve every job on the same capture, on any machine.

What `sfm` leaves in `run/sfm/<photos>/model-<settings>` is named by what it was computed from, so that a copy is as
good as the original wherever the names agree. The same tree lies in storage under `captures/{id}/sfm`.
"""

from pathlib import Path

from splatmill.backplane import layout
from splatmill.backplane.storage import Storage

_FOLDER = "sfm"
_WHOLE = "facts.json"
"""`sfm` gives a model's folder its name once all is in it. Here it is copied file by file, this one last: a model
without it is not one yet."""


def fetch(storage: Storage, capture_id: str, run: Path) -> int:
    """Bring what jobs before recovered from a capture into the `run` folder. Returns how many models came."""
    prefix = layout.capture_sfm(capture_id)
    names = [entry.path[len(prefix) + 1 :] for entry in storage.entries(prefix)]
    fetched = 0
    for mark in (name for name in names if name.endswith(f"/{_WHOLE}")):
        folder = mark.removesuffix(_WHOLE)
        if (run / _FOLDER / mark).is_file():
            continue
        for name in [*(n for n in names if n.startswith(folder) and n != mark), mark]:
            storage.download(f"{prefix}/{name}", run / _FOLDER / name)
        fetched += 1
    return fetched


def share(storage: Storage, capture_id: str, run: Path) -> int:
    """Store the models of the `run` folder that storage does not have. Returns how many that were."""
    prefix = layout.capture_sfm(capture_id)
    shared = 0
    for mark in sorted((run / _FOLDER).glob(f"*/model-*/{_WHOLE}")):
        target = f"{prefix}/{mark.parent.relative_to(run / _FOLDER).as_posix()}"
        if storage.exists(f"{target}/{_WHOLE}"):
            continue
        for path in [*(p for p in sorted(mark.parent.iterdir()) if p.is_file() and p != mark), mark]:
            storage.put(f"{target}/{path.name}", path)
        shared += 1
    return shared
