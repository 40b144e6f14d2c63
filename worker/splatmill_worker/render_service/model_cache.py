"""Stored models in memory; the least recently used ones are dropped when all together exceed a number of bytes."""

from __future__ import annotations

import json
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Entry, Storage
from splatmill_worker.errors import ModelNotFound

if TYPE_CHECKING:
    from splatmill_worker.scene import Camera
    from splatmill_worker.splat.gaussians import Gaussians


@dataclass(frozen=True)
class LoadedModel:
    """A model in memory, as it is rendered.

    id: id of the model.
    etag: storage's tag of model.ply, which changes with its contents.
    gaussians: its parameters, on the device that renders them.
    antialias: whether it was trained with compensation for the pixel filter, and must be rendered with it.
    bytes: memory of its parameters.
    backend: the kernels that render it; None means those of the parameters' device.
    offset: world = model + offset, as in splat.formats.contents.
    reads: returns the Gaussians that a camera sees, of a model that is in memory in part; `gaussians` are then those of
        an overview. None: the model is whole.
    """

    id: str
    etag: str
    gaussians: Gaussians
    antialias: bool
    bytes: int
    backend: str | None = None
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reads: Callable[[Camera], Gaussians] | None = None

    def seen_by(self, camera: Camera) -> Gaussians:
        """The Gaussians that the view of `camera` is drawn from. Raises ModelUnreadable for a damaged file."""
        return self.gaussians if self.reads is None else self.reads(camera)


class ModelCache:
    """The models that were used last, by id. A model that has changed in storage is read again.

    storage: where the models are.
    max_bytes: bound on the memory of all models. A larger one is rendered, too, alone: it is kept until the next model.
    backend: the kernels that the models are loaded for, as in LoadedModel.
    """

    def __init__(self, storage: Storage, max_bytes: int, backend: str | None = None) -> None:
        self._storage = storage
        self._max_bytes = max_bytes
        self._backend = backend
        self._models: OrderedDict[str, LoadedModel] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def bytes(self) -> int:
        """Memory of all models in the cache."""
        # A copy, because another thread may load a model.
        return sum(model.bytes for model in [*self._models.values()])

    def etag(self, model_id: str) -> str:
        """Return storage's present tag of a model, without reading it. Raises ModelNotFound."""
        return self._entry(model_id).etag

    def _entry(self, model_id: str) -> Entry:
        entry = None
        if layout.is_id(model_id) and self._storage.exists(layout.job_record(model_id)):
            entry = self._storage.head(layout.model_file(model_id, "model.ply"))
        if entry is None:
            raise ModelNotFound(model_id)
        return entry

    def get(self, model_id: str) -> LoadedModel:
        """Return the model as it is stored now. Raises ModelNotFound, and ModelUnreadable for a damaged file."""
        entry = self._entry(model_id)
        with self._lock:
            model = self._models.get(model_id)
            if model is None or model.etag != entry.etag:
                self._models.pop(model_id, None)
                # Before it is read, so that old and new never are in memory together; a file is a little larger.
                self._make_room(entry.size)
                model = self._load(model_id, entry.etag)
                self._make_room(model.bytes)
                self._models[model_id] = model
            self._models.move_to_end(model_id)
            return model

    def _make_room(self, size: int) -> None:
        """Drop the models that were not used for longest until one of `size` bytes fits beside the others."""
        while self._models and self.bytes + size > self._max_bytes:
            self._models.popitem(last=False)

    def _load(self, model_id: str, etag: str) -> LoadedModel:
        from splatmill_worker.splat.formats import ply

        path = layout.model_file(model_id, "model.ply")
        local = self._storage.local_path(path)
        if local is not None:
            contents = ply.read(local)
        else:
            with tempfile.TemporaryDirectory(prefix="splatmill-model-") as folder:
                self._storage.download(path, Path(folder) / "model.ply")
                contents = ply.read(Path(folder) / "model.ply")
        gaussians = contents.gaussians
        if self._backend == "gpu":
            gaussians = gaussians.map(lambda tensor: tensor.cuda())
        size = sum(t.numel() * t.element_size() for t in gaussians)
        said = contents.antialiased
        antialias = self._antialias(model_id) if said is None else said
        return LoadedModel(model_id, etag, gaussians, antialias, size, self._backend, contents.offset)

    def _antialias(self, model_id: str) -> bool:
        """Return what the plan in the model's report says of antialiasing; False without a report or a plan."""
        try:
            return antialias_of(self._storage.get(layout.model_file(model_id, "report.json")))
        except FileNotFoundError:
            return False


def antialias_of(report: bytes) -> bool:
    """Return what the plan in a report.json says of antialiasing; False for a report without one."""
    try:
        fields: Any = json.loads(report)
        decision = fields["plan"]["antialias"]
    except (ValueError, KeyError, TypeError):
        return False
    return bool(decision["value"] if isinstance(decision, dict) else decision)
