"""Stored models in memory, the longest unused ones dropped when they exceed a bound in bytes."""

from __future__ import annotations

import json
import tempfile
import threading
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatmill.backplane import layout
from splatmill.backplane.storage import Storage

if TYPE_CHECKING:
    from splatmill_worker.splat.gaussians import Gaussians


class NoModelError(LookupError):
    """There is no finished model with this id."""


@dataclass(frozen=True)
class StoredModel:
    """A model as it is rendered. `etag` changes with its bytes, `antialias` is how it was trained, `backend`
    what renders it (None: the kernels of the device that its tensors are on)."""

    id: str
    etag: str
    gaussians: Gaussians
    antialias: bool
    bytes: int
    backend: str | None = None


class ModelCache:
    """Models by id, read from storage when first asked for, and anew when they changed there."""

    def __init__(self, storage: Storage, max_bytes: int, backend: str | None = None) -> None:
        self._storage = storage
        self._max_bytes = max_bytes
        self._backend = backend
        self._models: OrderedDict[str, StoredModel] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def bytes(self) -> int:
        """What the models in memory take."""
        return sum(model.bytes for model in self._models.values())

    def etag(self, model_id: str) -> str:
        """The present version of a model, without reading it. Raises NoModelError."""
        entry = None
        if layout.is_id(model_id) and self._storage.exists(layout.job_record(model_id)):
            entry = self._storage.head(layout.model_file(model_id, "model.ply"))
        if entry is None:
            raise NoModelError(model_id)
        return entry.etag

    def get(self, model_id: str) -> StoredModel:
        """The model as stored now. Raises NoModelError, and ModelUnreadable for a damaged file.

        A model larger than the bound is still served; it is then the only one kept.
        """
        etag = self.etag(model_id)
        with self._lock:
            known = self._models.get(model_id)
            if known is None or known.etag != etag:
                self._models.pop(model_id, None)
                known = self._read(model_id, etag)
                self._models[model_id] = known
                while self.bytes > self._max_bytes and len(self._models) > 1:
                    self._models.popitem(last=False)
            self._models.move_to_end(model_id)
            return known

    def _read(self, model_id: str, etag: str) -> StoredModel:
        from splatmill_worker.splat import ply

        path = layout.model_file(model_id, "model.ply")
        local = self._storage.local_path(path)
        if local is not None:
            gaussians = ply.read(local)
        else:
            with tempfile.TemporaryDirectory(prefix="splatmill-model-") as folder:
                self._storage.download(path, Path(folder) / "model.ply")
                gaussians = ply.read(Path(folder) / "model.ply")
        if self._backend == "gpu":
            gaussians = gaussians.map(lambda tensor: tensor.cuda())
        size = sum(t.numel() * t.element_size() for t in gaussians)
        return StoredModel(model_id, etag, gaussians, self._antialias(model_id), size, self._backend)

    def _antialias(self, model_id: str) -> bool:
        """Whether training compensated for the pixel filter; a view of such a model must do so as well."""
        try:
            report: Any = json.loads(self._storage.get(layout.model_file(model_id, "report.json")))
            decided = report["plan"]["antialias"]
        except (FileNotFoundError, ValueError, KeyError, TypeError):
            return False  # a model from elsewhere, or from before the plan was recorded
        return bool(decided["value"] if isinstance(decided, dict) else decided)
