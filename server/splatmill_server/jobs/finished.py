"""What the jobs that ended with a model took: seconds by stage, read from the reports of the newest models."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from splatmill.backplane import lists
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill_server.base.lists import Lists

NEWEST = 40
"""Number of the newest models that are looked at. Older ones tell of earlier versions and machines."""


@dataclass(frozen=True)
class Figures:
    """What one job took.

    photos: number of photos with a camera.
    posed: whether the cameras came with the photos.
    preset: the preset of its options.
    sized: whether its options gave the size of the photos.
    image_size: longest side of the photos in training, pixels.
    steps: training steps.
    kernels: cpu, gpu or reference.
    machine: processor or GPU, and number of cores.
    cameras: seconds of the recovery of the cameras, also where an earlier job of the capture had recovered them.
    train: seconds of training.
    by_photo: seconds of loading and measuring, which grow with the number of photos.
    fixed: seconds of all else, from the start of the first attempt to the end.
    pixel_share: share of the time of a step that is spent on pixels, 0 to 1; the rest is spent on Gaussians.
    """

    photos: int
    posed: bool
    preset: str
    sized: bool
    image_size: int
    steps: int
    kernels: str
    machine: str
    cameras: float
    train: float
    by_photo: float
    fixed: float
    pixel_share: float


class Finished:
    """The figures of the newest models. Each report is read once."""

    def __init__(self, storage: Storage, listed: Lists) -> None:
        self._storage = storage
        self._lists = listed
        self._known: dict[tuple[int, str], Figures | None] = {}

    def newest(self) -> list[Figures]:
        """Return the figures of the newest models, newest first, without those that cannot be read.

        Raises StorageError if storage cannot be read, redis.RedisError, and a 503 problem while lists are being made.
        """
        newest = self._lists.newest([lists.name("models")], None, NEWEST)
        # Without a lock, which a storage that does not answer would hold: two threads may read the same report.
        known = self._known
        self._known = read = {key: known[key] if key in known else self._read(key[1]) for key in newest}
        return [figures for figures in read.values() if figures is not None]

    def _read(self, model_id: str) -> Figures | None:
        try:
            job = json.loads(self._storage.get(layout.job_record(model_id)))
            report = json.loads(self._storage.get(layout.model_file(model_id, "report.json")))
            return figures(job, report)
        except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError):
            return None  # deleted meanwhile, or by a version that wrote other fields


def figures(job: Mapping[str, Any], report: Mapping[str, Any]) -> Figures | None:
    """Return the figures of a job from its `job.json` and `report.json`, or None for one whose times are not its own: a
    job of several attempts, and an edited model, which has the report of the job that trained it.

    Raises KeyError, TypeError, ValueError and AttributeError for records without the fields.
    """
    if job.get("attempt") != 1 or "edit" in report:
        return None  # the wall time includes what was lost, and waiting, or all until the edit
    seconds, facts, plan = report["seconds"], report["facts"], report["plan"]
    options = job.get("options", {})
    wall = (_time(job["finished_at"]) - _time(job["started_at"])).total_seconds()
    recovered = sum(map(float, (report.get("sfm") or {}).get("seconds", {}).values()))
    by_photo = float(seconds.get("load", 0.0)) + float(seconds["evaluate"])
    rest = wall - float(seconds["sfm"]) - float(seconds["train"]) - by_photo
    figures_of_job = Figures(
        photos=int(facts["views"]) + int(facts["held_out"]),
        posed=facts["source"] != "sfm",
        preset=str(options.get("preset", "balanced")),
        sized=options.get("image_size") is not None,
        image_size=int(plan["image_size"]),
        steps=int(report["result"]["steps"]),
        kernels=str(plan["kernels"]),
        machine=_machine(report["machine"], str(plan["kernels"])),
        cameras=max(float(seconds["sfm"]), recovered),
        train=float(seconds["train"]),
        by_photo=by_photo,
        fixed=max(0.0, rest - float(seconds.get("film", 0.0))),
        pixel_share=_pixel_share(facts, int(report["result"]["gaussians"])),
    )
    return (
        figures_of_job
        if figures_of_job.photos > 0 and figures_of_job.steps > 0 and figures_of_job.image_size > 0
        else None
    )


def _pixel_share(facts: Mapping[str, Any], gaussians: int) -> float:
    speed = facts.get("speed") or {}
    pixels = float(speed.get("per_pixel", 0.0)) * facts["width"] * facts["height"]
    both = pixels + float(speed.get("per_gaussian", 0.0)) * gaussians
    return pixels / both if both > 0.0 else 0.0


def _machine(machine: Mapping[str, Any], kernels: str) -> str:
    if kernels == "gpu" and machine.get("gpu"):
        gpu = machine["gpu"]
        return str(gpu.get("name", "GPU") if isinstance(gpu, dict) else gpu)
    return f"{machine['processor']}, {machine['cores']} cores"


def _time(text: str) -> datetime:
    return datetime.fromisoformat(text)
