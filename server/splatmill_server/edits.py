"""Models made from models: what the renderer leaves of one becomes another, with its photos and its report."""

import json
from collections.abc import AsyncIterator
from typing import Any

from starlette.concurrency import run_in_threadpool

from splatmill.backplane.jobs.row import now
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import HELD_OUT, Edited, EditModel
from splatmill_server.jobs.records import read_model_record
from splatmill_server.space.quota import Arrival

STALE = ("time_lapse", "views", "disagreement", "misfits", "warnings")
"""Parts of a training's report that an edited model has not."""

_LONGEST_NAME = 200
"""Characters of a name, as `Label` allows."""

UNMEASURED = ("mse", "psnr_color_fitted", "lpips_vgg", "lpips_alex")
"""Scores of held-out photos that the renderer does not measure of an edited model."""


async def store_edited(
    storage: Storage,
    model_id: str,
    request: EditModel,
    edited: Edited,
    ply: AsyncIterator[bytes],
    room: Arrival,
) -> str:
    """Store an edited model and return its id. Its record is written last; if anything fails, nothing is left.

    model_id: the model that was edited, which is not changed.
    ply: its new model.ply.
    room: where each file is reserved before it is stored.
    """
    new_id = room.record_id
    try:
        await storage.stream_put(layout.model_file(new_id, "model.ply"), room.counted(ply))
        await run_in_threadpool(_store_others, storage, model_id, new_id, request, edited, room)
    except BaseException:
        await run_in_threadpool(storage.delete_prefix, layout.model(new_id))
        raise
    return new_id


def _store_others(
    storage: Storage, model_id: str, new_id: str, request: EditModel, edited: Edited, room: Arrival
) -> None:
    """Store what an edited model has beside model.ply, its record last."""

    def put(name: str, content: bytes) -> None:
        room.take(len(content))
        storage.put(layout.model_file(new_id, name), content)

    for entry in storage.entries(layout.model_file(model_id, HELD_OUT)):
        name = entry.path.removeprefix(layout.model(model_id) + "/")
        put(name, storage.get(entry.path))
    scores = {} if request.crops else {view.name: view for view in edited.views}
    cameras = _read(storage, model_id, "cameras.json")
    if cameras:
        for row in cameras.get("cameras", []):
            for stale in ("psnr", "psnr_color_fitted", "ssim"):
                row.pop(stale, None)
            if (score := scores.get(row.get("name"))) is not None:
                row |= score.model_dump(mode="json", include={"psnr", "ssim"})
        put("cameras.json", json.dumps(cameras, indent=1).encode())
    if frame := _read(storage, model_id, "frame.json"):
        put("frame.json", json.dumps(frame, indent=1).encode())
    report = _edited_report(_read(storage, model_id, "report.json"), model_id, request, edited)
    put("report.json", json.dumps(report, indent=1).encode())
    moment = now().isoformat()
    job, record = read_model_record(storage, model_id)
    record |= {
        "id": new_id,
        "model": new_id,
        "name": request.name or _name(job.name, request),
        "tags": job.tags,
        "favourite": False,
        "created_at": moment,
        "finished_at": moment,
        "sha256": {},
    }
    put("job.json", json.dumps(record, indent=1).encode())


def _edited_report(
    report: dict[str, Any], model_id: str, request: EditModel, edited: Edited
) -> dict[str, Any]:
    """The report of the training, with the last point of its curve and the result as they are after the edit.

    The photos show what a crop has left out, so that the scores of a crop are no measure of its quality: they stand
    under `edit` alone.
    """
    ssims = [view.ssim for view in edited.views if view.ssim is not None]
    scores = {"psnr": edited.psnr, "ssim": sum(ssims) / len(ssims) if ssims else None}
    measured = {"gaussians": edited.gaussians, **(dict.fromkeys(scores) if request.crops else scores)}
    last = (report.get("curve") or [{"seconds": 0.0, "step": 0}])[-1]
    done = request.model_dump(mode="json", exclude_none=True, exclude={"name", "preview", "selection"})
    if request.selection is not None:
        done["selection"] = len(request.selection.strokes)
    return {
        **{name: value for name, value in report.items() if name not in STALE},
        "seconds": report.get("seconds") or {},
        "curve": [last | measured],
        "result": {**(report.get("result") or {}), **dict.fromkeys(UNMEASURED), **measured},
        "edit": {"model": model_id, **done, "psnr_before": edited.psnr_before, "psnr": edited.psnr},
    }


def _name(name: str | None, request: EditModel) -> str | None:
    """The name of an edited model where none is asked for."""
    what = ", cropped" if request.crops else ", cleaned"
    return name and name[: _LONGEST_NAME - len(what)] + what


def _read(storage: Storage, model_id: str, name: str) -> dict[str, Any]:
    """A JSON file of a model; {} where it has none that can be read."""
    try:
        content = json.loads(storage.get(layout.model_file(model_id, name)))
    except (FileNotFoundError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
