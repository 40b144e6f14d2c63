"""Gives hostile inputs to the real parts: the server over raw sockets with a real Redis, and the worker's own code."""

from __future__ import annotations

import contextlib
import json
import logging
import re
import shutil
import socket
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import redis
import structlog

from splatmill.backplane.connection import connect
from splatmill.schema import TrainOptions
from splatmill_server.base.settings import Settings
from splatmill_worker.errors import WorkerError
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.prepare import prepare
from splatmill_worker.pipeline.capture import posed_scene
from splatmill_worker.scene import Normalization
from splatmill_worker.splat.start.given_model import read_given_model
from tests.support.hostile.pictures import photo, write
from tests.support.redis_server import empty_redis
from tests.support.served_app import ServedApp, served_app

MAX_FILES = 50
"""Files in a capture that the server under test accepts."""


@dataclass(frozen=True)
class Answer:
    """What became of an input.

    kind: the HTTP status, with the code of a problem document; or what the worker does with the file.
    said: the detail of the problem, the reason, or the note.
    """

    kind: str
    said: str


class Bench:
    """A server with a capture, and a folder for the worker. Each input gets both anew."""

    def __init__(self, app: ServedApp, folder: Path) -> None:
        self.app = app
        self._folder = folder

    # The server

    def capture(self) -> str:
        return self.app.capture()

    def put(self, name: str, body: bytes = b"photo", *headers: str, capture: str | None = None) -> Answer:
        """PUT a file; `name` begins with the role, and is sent as it is written here."""
        return self.request(f"PUT /v1/captures/{capture or self.capture()}/{name}", body, *headers)

    def post(self, path: str, body: bytes | object, *headers: str) -> Answer:
        """POST a body as JSON."""
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        return self.request(f"POST {path}", data, *(headers or ("Content-Type: application/json",)))

    def form(self, *parts: tuple[str, bytes], end: bytes = b"--B--\r\n") -> Answer:
        """POST a form of parts, each with its headers' Content-Disposition, to /v1/jobs."""
        body = b"".join(
            b"--B\r\nContent-Disposition: form-data; %s\r\n\r\n%s\r\n" % (head.encode(), data)
            for head, data in parts
        )
        return self.request("POST /v1/jobs", body + end, "Content-Type: multipart/form-data; boundary=B")

    def request(
        self, line: str, body: bytes = b"", *headers: str, length: int | None = None, cut: bool = False
    ) -> Answer:
        """Send a request with these bytes, and read what comes back; with `cut`, say that nothing follows."""
        head = [f"{line} HTTP/1.1", "Connection: close"]
        head += [] if any(header.startswith("Host:") for header in headers) else ["Host: 127.0.0.1"]
        if not any(header.startswith(("Content-Length:", "Transfer-Encoding:")) for header in headers):
            head.append(f"Content-Length: {len(body) if length is None else length}")
        return self.send("\r\n".join([*head, *headers, "", ""]).encode("latin-1") + body, cut=cut)

    def send(self, data: bytes, *, cut: bool = False) -> Answer:
        """Send these bytes over a new connection, and read what comes back."""
        with socket.create_connection(self.app.address, 20) as link:
            with contextlib.suppress(ConnectionError):  # the server may answer and close before all is sent
                link.sendall(data)
                if cut:
                    link.shutdown(socket.SHUT_WR)
            received = b""
            with contextlib.suppress(ConnectionError):
                while len(received) < 2**20 and (chunk := link.recv(65536)):
                    received += chunk
        return _answer(received)

    # The worker

    def prepared(self, name: str, data: bytes, beside: Mapping[str, bytes] | None = None) -> Answer:
        """What preparation does with a file of a capture that has another, usable photo.

        name: with its folder, images/ or masks/.
        """
        capture = self._fresh()
        for path, content in {"images/good.jpg": photo(99), name: data, **(beside or {})}.items():
            write(capture / path, content)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                outcome = prepare(capture / "images", capture / "masks", capture / "work", frames=4)
            except WorkerError as error:
                return Answer(f"the job fails: `{error.code}`", error.message)
        skipped = [f"{where}: {reason}" for where, reason in outcome.skipped]
        used = [row for row in outcome.photos if row.name != "good.jpg" or row.mask is not None]
        notes = [note for note in outcome.notes if "frames were taken" not in note]
        notes += [warning for warning in outcome.warnings if "mask" in warning]
        if skipped:
            return Answer("left out", "; ".join(skipped))
        if notes:
            return Answer("used, with a note" if used else "not used, with a note", " ".join(notes))
        return Answer("used", f"{len(used)} photo{'s' if len(used) != 1 else ''}")

    def posed(self, files: Mapping[str, bytes], photos: int = 3) -> Answer:
        """What the worker makes of cameras that came with photos called 1.jpg, 2.jpg ..."""
        capture = self._fresh()
        for number in range(1, photos + 1):
            write(capture / "images" / f"{number}.jpg", photo(number))
        for name, content in files.items():
            write(capture / name, content)
        try:
            scene = posed_scene(capture, capture / "work", TrainOptions(), lambda *_: None, lambda: False)
        except WorkerError as error:
            return Answer(f"the job fails: `{error.code}`", error.message)
        said = [f"{name} is left out: {reason}" for name, reason in scene.left_out]
        notes = [note for note in scene.notes if "Stereo" not in note]
        return Answer(f"used: {len(scene.views)} cameras", " ".join([*notes, *scene.warnings, *said]))

    def start(self, data: bytes, suffix: str = ".ply") -> Answer:
        """What the worker makes of a file to start from, whose suffix names its format."""
        path = write(self._fresh() / f"start{suffix}", data)
        try:
            gaussians = read_given_model(path, Normalization(1.0, np.zeros(3)), 1000).gaussians
        except WorkerError as error:
            return Answer(f"the job fails: `{error.code}`", error.message)
        return Answer("used", f"{gaussians.count} Gaussians")

    def _fresh(self) -> Path:
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir(parents=True)
        return self._folder


@contextlib.contextmanager
def bench() -> Iterator[Bench]:
    """Start the server and its Redis."""
    before = structlog.get_config()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    logging.getLogger("python_multipart").setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        stack.callback(structlog.configure, **before)
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hostile-")))
        url = stack.enter_context(empty_redis(place / "redis"))
        client: redis.Redis = connect(url)
        stack.callback(client.close)
        settings = Settings(
            redis_url=url,
            data=place / "data",
            storage="",
            api_key=None,
            reaper_interval=3600,
            max_files_per_capture=MAX_FILES,
        )
        captures = place / "captures"
        captures.mkdir()
        # As in an attempt (service/attempts/run_attempt), but for the reader, whose start would take most of the time.
        stack.enter_context(decoders.confined([captures], keep_reader=True))
        yield Bench(stack.enter_context(served_app(settings, client)), captures / "one")


def _answer(received: bytes) -> Answer:
    head, _, body = received.partition(b"\r\n\r\n")
    words = head.split(None, 2)
    if len(words) < 2:
        return Answer("no answer", "the connection is closed")
    status = words[1].decode()
    if b"transfer-encoding: chunked" in head.lower():
        body = re.sub(rb"(^|\r\n)[0-9a-f]+\r\n", b"", body)
    else:
        length = re.search(rb"content-length: (\d+)", head, re.IGNORECASE)
        body = body[: int(length[1])] if length is not None else body
    if b"application/problem+json" in head:
        document = json.loads(body)
        return Answer(f"{status} `{document['code']}`", document["detail"])
    if b"application/json" in head and "name" in (document := json.loads(body)):
        return Answer(status, f"the name is {document['name']!a}")
    return Answer(status, body[:100].decode("utf-8", "replace").partition("\n")[0])
