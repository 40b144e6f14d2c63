"""A folder of static files under one digest: `/page/DIGEST/base.css` can be cached for ever, because what lies there
never changes. Files refer to each other by relative addresses, so no build has to rewrite them."""

import gzip
import hashlib
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".mjs": "text/javascript; charset=utf-8",
    ".png": "image/png",
    ".svg": "image/svg+xml",
    ".wasm": "application/wasm",
    ".webp": "image/webp",
    "": "text/plain; charset=utf-8",
}
"""Media type of each suffix that may be served; "" is that of LICENSE files."""

_COMPRESSED = frozenset({".css", ".html", ".js", ".json", ".mjs", ".svg", ".wasm", ""})

_SMALL = 600
"""Bytes under which compression saves no packet."""

Signature = tuple[tuple[str, int, int], ...]


@dataclass(frozen=True)
class StaticFile:
    """A file of a tree.

    path: where it lies.
    media_type: what it is.
    etag: SHA-256 of its content, in hex, shortened.
    packed: its content compressed by gzip, or None where that saves nothing.
    """

    path: Path
    media_type: str
    etag: str
    packed: bytes | None


class Tree:
    """The files below `folder`. A folder that is not there is an empty tree.

    `digest` reads the files again when one of them has changed, so that somebody who works on the page sees it after a
    reload. Files under the digest that was read last are served without a look at the folder: a page loads dozens of
    them, and a look takes longer than to send one.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = threading.Lock()
        self._signature: Signature | None = None
        self._digests: dict[str, str] = {}
        self._files: dict[str, StaticFile] = {}
        self._digest = ""

    @property
    def digest(self) -> str:
        """The digest of all names and contents as they are now."""
        with self._lock:
            self._read()
            return self._digest

    def is_current(self, digest: str) -> bool:
        """Return whether `digest` is that of the files, which are looked at if it is not the one that was read last."""
        with self._lock:
            if digest != self._digest:
                self._read()
            return digest == self._digest

    def names(self) -> list[str]:
        """Return the names of all files."""
        with self._lock:
            self._read()
            return sorted(self._digests)

    def find(self, name: str) -> StaticFile | None:
        """Return a file by its name below the folder, or None if the tree does not have it."""
        with self._lock:
            if self._signature is None:
                self._read()
            digest = self._digests.get(name)
            if digest is None:
                return None
            if name not in self._files:
                path = self.folder / name
                self._files[name] = StaticFile(path, MEDIA_TYPES[path.suffix], digest, _pack(path))
            return self._files[name]

    def _read(self) -> None:
        signature = tuple(sorted(_served(self.folder)))
        if signature == self._signature:
            return
        contents = {
            name: hashlib.sha256((self.folder / name).read_bytes()).hexdigest() for name, _, _ in signature
        }
        lines = "".join(f"{digest} {name}\n" for name, digest in contents.items())
        self._digests = {name: digest[:32] for name, digest in contents.items()}
        self._digest = hashlib.sha256(lines.encode()).hexdigest()[:16]
        self._files = {}
        self._signature = signature


def _served(folder: Path, above: str = "") -> Iterator[tuple[str, int, int]]:
    """The name, time of change and size of each file below `folder` that may be served."""
    try:
        entries = os.scandir(folder)
    except FileNotFoundError:
        return
    with entries:
        for entry in entries:
            if entry.is_dir():
                yield from _served(folder / entry.name, f"{above}{entry.name}/")
            elif (
                Path(entry.name).suffix in MEDIA_TYPES and not entry.name.startswith(".") and entry.is_file()
            ):
                stat = entry.stat()
                yield f"{above}{entry.name}", stat.st_mtime_ns, stat.st_size


def _pack(path: Path) -> bytes | None:
    """Return the content compressed, or None if that is no smaller by a tenth."""
    content = path.read_bytes()
    if path.suffix not in _COMPRESSED or len(content) < _SMALL:
        return None
    packed = gzip.compress(content, 9, mtime=0)
    return packed if len(packed) < 0.9 * len(content) else None
