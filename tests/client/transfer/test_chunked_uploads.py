"""Large files against the real server: they go on where they stopped, whatever breaks, and arrive as they were.

Breaks are real: connections are cut by a proxy in between, the server is stopped and started again, and the command is
killed. Not proved here: the server's side in detail (tests/server/captures/test_partial_uploads.py).
"""

import asyncio
import contextlib
import hashlib
import math
import os
import random
import subprocess
import sys
import threading
import time

import pytest

from splatmill import Client
from splatmill.errors import ConnectionFailed, InvalidRequest, NothingToUpload
from splatmill.schema import Progress, storable_name
from splatmill.sdk.loop import BackgroundLoop
from splatmill.transfer import chunked_uploads, uploads
from tests.support.waiting import wait_for

SIZE = 3_000_000
DATA = random.Random(2).randbytes(SIZE)
SHA256 = hashlib.sha256(DATA).hexdigest()


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch):
    monkeypatch.setattr(chunked_uploads, "PIECE", 500_000)
    monkeypatch.setattr(uploads, "PIECE", 500_000)
    monkeypatch.setattr(uploads, "REPORT_SECONDS", 0)


@pytest.fixture
def film(tmp_path):
    path = tmp_path / "film.mp4"
    path.write_bytes(DATA)
    return path


class Proxy:
    """Passes connections on to the server, and cuts one after each entry of `cuts`: bytes from the client.

    room: bytes from the clients that are passed on in all. What else comes on a connection is lost, and not answered.
    """

    def __init__(self, target: str) -> None:
        self.port = int(target.rsplit(":", 1)[1])
        self.cuts: list[int] = []
        self.sent = 0
        self.room = math.inf
        self.loop = BackgroundLoop()
        self.server = self.loop.run(self._start())
        self.url = f"http://127.0.0.1:{self.server.sockets[0].getsockname()[1]}"

    async def _start(self) -> asyncio.Server:
        return await asyncio.start_server(self._serve, "127.0.0.1", 0)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", self.port)
        except OSError:
            writer.close()
            return
        left = self.cuts.pop(0) if self.cuts else None

        async def back() -> None:
            with contextlib.suppress(OSError):
                while data := await inner_reader.read(65536):
                    writer.write(data)
            writer.close()

        answering = asyncio.create_task(back())
        with contextlib.suppress(OSError):
            while data := await reader.read(65536):
                if left is not None:
                    data, left = data[:left], left - len(data)
                if self.sent + len(data) > self.room:
                    while await reader.read(65536):
                        pass
                    break
                self.sent += len(data)
                inner_writer.write(data)
                await inner_writer.drain()
                if left is not None and left <= 0:
                    break
        inner_writer.close()
        await asyncio.wait({answering})

    def close(self) -> None:
        self.loop.run(self._stop())
        self.loop.close()

    async def _stop(self) -> None:
        self.server.close()


@pytest.fixture
def proxy(service):
    made = Proxy(service.url)
    yield made
    made.close()


def stored(service, client, capture):
    [file] = client.capture(capture.id).files
    assert (file.size, file.sha256) == (SIZE, SHA256)
    return file


def test_a_large_file_is_sent_in_pieces_with_its_progress_in_bytes(service, film):
    heard: list[Progress] = []
    with Client(service.url) as client:
        capture, uploaded = client.upload(film, on_progress=heard.append)
        assert uploaded.files == (stored(service, client, capture),)
    done = [entry.done for entry in heard]
    assert done == sorted(done)
    assert (done[-1], heard[-1].total) == (SIZE, SIZE)
    assert len(set(done)) > 6


def test_lost_connections_cost_no_byte_twice_but_those_in_flight(service, film, proxy):
    proxy.cuts = [600_000, 5_000, 1_300_000, 100, 400_000]
    with Client(proxy.url) as client:
        capture, _ = client.upload(film)
        stored(service, client, capture)
    assert proxy.cuts == []
    # Each of the five breaks repeats less than what a piece holds; a whole repetition would send far more.
    assert SIZE <= proxy.sent < SIZE + 5 * 500_000


def test_a_restart_of_the_server_does_not_end_an_upload(service, film):
    reached = threading.Event()

    def restart() -> None:
        reached.wait()
        service.stop()
        time.sleep(0.2)
        service.start()

    restarting = threading.Thread(target=restart)
    restarting.start()

    def heard(progress: Progress) -> None:
        if progress.done > SIZE // 3:
            reached.set()

    with Client(service.url) as client:
        capture, _ = client.upload(film, on_progress=heard)
        restarting.join()
        stored(service, client, capture)


def test_a_server_that_stays_away_ends_the_upload_and_a_later_one_goes_on(service, film, proxy):
    with Client(proxy.url, retries=0) as client:
        proxy.cuts = [1_200_000]
        with pytest.raises(ConnectionFailed):
            client.upload(film, resume=True)
    sent = proxy.sent
    with Client(proxy.url) as client:
        capture, _ = client.upload(film, resume=True)
        stored(service, client, capture)
        assert proxy.sent < SIZE + 600_000
        assert sent > 1_000_000
        # Once more: nothing is sent, and it is the same capture.
        before = proxy.sent
        again, uploaded = client.upload(film, resume=True)
        assert again.id == capture.id
        assert uploaded.files[0].sha256 == SHA256
        assert proxy.sent - before < 5_000
        assert len(list(client.captures())) == 1
        # Without `resume`, and for other bytes, the capture is a new one.
        other, _ = client.upload(film)
        film.write_bytes(DATA[:-1])
        third, _ = client.upload(film, resume=True)
    assert len({capture.id, other.id, third.id}) == 3


def test_a_file_that_changes_meanwhile_is_refused_and_not_stored(service, film):
    def change(progress: Progress) -> None:
        if progress.done > SIZE // 2:
            with film.open("r+b") as file:
                file.write(b"\0" * SIZE)

    with Client(service.url) as client:
        with pytest.raises(InvalidRequest, match="SHA-256"):
            client.upload(film, on_progress=change)
        [capture] = client.captures()
        assert client.capture(capture.id).files == []
        with pytest.raises(NothingToUpload, match="has changed while"):
            client.upload(film, on_progress=lambda _: os.truncate(film, 1000))


@pytest.mark.slow
def test_a_command_that_was_killed_goes_on_in_the_same_capture(service, tmp_path, proxy):
    """`splatmill train`, killed in the middle of the upload and run again."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for n in range(3):
        (folder / f"{n}.jpg").write_bytes(DATA[:1000] + bytes([n]))
    big = 40_000_000
    (folder / "big.jpg").write_bytes(random.Random(3).randbytes(big))
    proxy.room = 18_000_000
    arguments = [folder, "--server", proxy.url, "--detach", "-o", tmp_path / "out"]
    command = [sys.executable, "-m", "splatmill", "train", *arguments]
    environment = {**os.environ, "SPLATMILL_API_KEY": ""}
    first = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    wait_for(lambda: proxy.sent > 17_000_000)
    first.kill()
    first.wait()
    sent, proxy.room = proxy.sent, math.inf
    second = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert second.returncode == 0, second.stderr
    with Client(service.url) as client:
        [capture] = client.captures()
        files = {file.name: file.sha256 for file in client.capture(capture.id).files}
        assert files == {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.iterdir()}
        assert client.job(second.stdout.split()[-1]).job.capture == capture.id
    # What the first command had sent was not sent again, but for what was in flight.
    assert proxy.sent - sent < big - 16_000_000


def test_one_bad_name_is_stored_under_another_and_one_is_refused(service, tmp_path):
    deep = "/".join(["a"] * 17) + ".jpg"
    for name in ("plain.jpg", " lead.jpg", deep):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(os.urandom(100))
    with Client(service.url) as client:
        capture, uploaded = client.upload(tmp_path)
        held = {file.name for file in client.capture(capture.id).files}
    assert uploaded.renamed == ((" lead.jpg", storable_name(" lead.jpg")),)
    assert held == {"plain.jpg", storable_name(" lead.jpg")}
    [(name, problem)] = uploaded.refused
    assert (name, problem.code) == (deep, "name_invalid")


def test_a_photo_that_is_deleted_during_the_upload_is_left_out_by_name(service, tmp_path):
    for number in range(12):
        (tmp_path / f"{number:02}.jpg").write_bytes(os.urandom(100))
    last = tmp_path / "11.jpg"
    with Client(service.url) as client:
        capture, uploaded = client.upload(tmp_path, on_progress=lambda event: last.unlink(missing_ok=True))
        held = {file.name for file in client.capture(capture.id).files}
    assert held == {f"{number:02}.jpg" for number in range(11)}
    [(name, problem)] = uploaded.refused
    assert (name, problem.code) == ("11.jpg", "file_not_found")
    assert "No such file" in problem.detail
