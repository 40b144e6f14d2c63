"""Storage in a bucket that fails: requests without an answer, cut connections and answers 500 and 503 are repeated, up
to a limit, and end as named errors; and the API does without storage what it can.

The bucket is moto's server behind a proxy that spoils requests. Not proved here: how long Amazon's own outages last.
"""

import asyncio
import contextlib
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.bucket import BLOCK, Patience
from splatmill.backplane.storage.errors import (
    StorageBusyError,
    StorageChangedError,
    StorageError,
    StorageStalledError,
    StorageUnreachableError,
)
from splatmill.backplane.storage.slots import NoSlot, Slots
from splatmill.backplane.storage.storage import SLOTS, Storage
from splatmill.schema import Role
from tests.support.served_app import Serve, problem
from tests.support.servers.faulty_s3 import Fault, FaultyS3, Request, faulty_s3
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow

RETRIES = 2
USUAL = Patience(answer=20.0, block=20.0, retries=RETRIES, slot=0.05)
SHORT = Patience(answer=0.3, block=0.3, retries=RETRIES)
"""For requests that get no answer at all. A loaded machine may take longer for one."""


@pytest.fixture(scope="module")
def served() -> Iterator[FaultyS3]:
    with faulty_s3() as s3:
        yield s3


@pytest.fixture
def s3(served: FaultyS3) -> Iterator[FaultyS3]:
    yield served
    served.reset()


@pytest.fixture
def storage(s3: FaultyS3) -> Storage:
    return Storage(f"{s3.storage}/{secrets.token_hex(8)}", patience=USUAL)


async def read(storage: Storage, path: str, start: int = 0, end: int | None = None) -> bytes:
    return b"".join([piece async for piece in storage.stream_get(path, start, end)])


OPERATIONS: dict[str, Callable[[Storage], object]] = {
    "get": lambda storage: storage.get("file"),
    "head": lambda storage: storage.head("file"),
    "list": lambda storage: list(storage.entries("")),
    "put": lambda storage: storage.put("file", b"bytes"),
    "delete": lambda storage: storage.delete("file"),
    "stream": lambda storage: asyncio.run(read(storage, "file")),
}


@pytest.mark.parametrize(
    ("operation", "fault"),
    [
        *((operation, fault) for operation in OPERATIONS for fault in ("cut", 500, 503)),
        *((operation, "stall") for operation in ("get", "put", "delete", "stream")),
    ],
)
def test_a_request_that_fails_once_is_repeated(
    s3: FaultyS3, storage: Storage, operation: str, fault: Fault
) -> None:
    storage.put("file", b"bytes")
    s3.first(1, fault)
    asked = storage if fault != "stall" else Storage(storage.url, patience=Patience(answer=1.5, block=1.5))
    OPERATIONS[operation](asked)
    assert storage.exists("file") is (operation != "delete")


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("stall", StorageStalledError),
        ("cut", StorageUnreachableError),
        (500, StorageUnreachableError),
        (503, StorageUnreachableError),
    ],
)
@pytest.mark.parametrize("operation", OPERATIONS)
def test_a_request_that_always_fails_ends_as_a_named_error(
    s3: FaultyS3, storage: Storage, operation: str, fault: Fault, named: type[StorageError]
) -> None:
    storage.put("file", b"bytes")
    s3.requests.clear()
    s3.fault = lambda _: fault
    asked = storage if fault != "stall" else Storage(storage.url, patience=SHORT)
    with pytest.raises(named) as caught:
        OPERATIONS[operation](asked)
    assert "\n" not in str(caught.value)
    assert "Debug source" not in str(caught.value)
    # The reading of a stream counts its repetitions anew on each level, of which there are two.
    assert 2 <= len(s3.requests) <= (RETRIES + 1) ** (2 if operation == "stream" else 1)


def test_a_bucket_that_nobody_serves_is_not_reached(monkeypatch: pytest.MonkeyPatch, s3: FaultyS3) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    with pytest.raises(StorageUnreachableError, match="could not read file"):
        Storage(s3.storage, patience=USUAL).get("file")


def test_a_new_file_whose_answer_is_lost_is_there_once(s3: FaultyS3, storage: Storage) -> None:
    s3.first(1, "deaf")
    assert not storage.put_new("claim", b"mine")  # the repetition finds the bytes of the first request
    assert storage.get("claim") == b"mine"
    assert not storage.put_new("claim", b"other")
    assert storage.get("claim") == b"mine"


def test_a_large_file_goes_up_in_blocks_and_only_a_failed_block_is_sent_again(
    s3: FaultyS3, storage: Storage, tmp_path: Path
) -> None:
    data = secrets.token_bytes(1 << 20) * 17  # three blocks
    (tmp_path / "large").write_bytes(data)
    s3.requests.clear()
    failed: list[str] = []

    def second_block(request: Request) -> Fault:
        if "partNumber=2" in request.path and not failed:
            failed.append(request.path)
            return 503
        return None

    s3.fault = second_block
    storage.put("large", tmp_path / "large")
    parts = sorted(
        request.path.partition("partNumber=")[2][:1]
        for request in s3.requests
        if "partNumber" in request.path
    )
    assert parts == ["1", "2", "2", "3"]
    assert max(int(request.headers.get("content-length", 0)) for request in s3.requests) == BLOCK
    assert storage.get("large") == data


def test_a_stream_that_fits_into_a_block_is_one_request(s3: FaultyS3, storage: Storage) -> None:
    async def chunks(count: int):
        for i in range(count):
            yield bytes([i]) * 1_000_000

    s3.requests.clear()
    asyncio.run(storage.stream_put("small", chunks(3)))
    assert [request.method for request in s3.requests] == ["PUT"]
    asyncio.run(storage.stream_put("large", chunks(9)))
    assert len(storage.get("large")) == 9_000_000


def test_a_large_file_comes_down_whole_over_a_line_that_breaks_again_and_again(
    s3: FaultyS3, storage: Storage, tmp_path: Path
) -> None:
    data = secrets.token_bytes(1 << 20) * 6
    storage.put("large", data)
    s3.half = lambda request: 1_200_000 if request.method == "GET" else None
    # Five breaks: more than one reading may have without progress.
    assert asyncio.run(read(storage, "large")) == data
    assert asyncio.run(read(storage, "large", 1_000, 6_000_000)) == data[1_000:6_000_000]
    storage.download("large", tmp_path / "large")
    assert (tmp_path / "large").read_bytes() == data


def test_a_file_that_is_replaced_while_it_is_read_is_not_mixed(s3: FaultyS3, storage: Storage) -> None:
    storage.put("model", b"a" * 6_000_000)

    async def replaced() -> None:
        reading = storage.stream_get("model")
        s3.half = lambda request: 2_500_000
        async for _ in reading:
            storage.put("model", b"b" * 6_000_000)

    with pytest.raises(StorageChangedError, match="replaced"):
        asyncio.run(replaced())


def test_a_reader_that_is_slow_gets_every_byte(s3: FaultyS3) -> None:
    """A body may take longer than any time limit, as long as its reader reads: the limits here are a fraction of it."""
    url = f"{s3.storage}/{secrets.token_hex(8)}"
    Storage(url).put("model", b"m" * (8 << 20))
    storage = Storage(url, patience=Patience(block=0.5, retries=20))

    async def slowly() -> int:
        count = 0
        async for piece in storage.stream_get("model"):
            count += len(piece)
            await asyncio.sleep(0.15)
        return count

    assert asyncio.run(slowly()) == 8 << 20


def test_a_model_goes_to_a_slow_client_without_being_held_in_memory(s3: FaultyS3, serve: Serve) -> None:
    app = serve(storage=f"{s3.storage}/{secrets.token_hex(8)}")
    job_id = app.job()
    app.begin(job_id)
    app.finish(job_id)
    size = 64 << 20
    app.service.storage.put(layout.model_file(job_id, "model.ply"), bytes(size))
    with app.http.stream("GET", f"/v1/models/{job_id}/files/model.ply") as answer:
        pieces = answer.iter_raw()
        count = len(next(pieces))
        wait_for(lambda: s3.untaken)
        # The client reads no further, and most of the file waits on the side of the bucket.
        assert s3.untaken > size / 2
        assert app.http.get("/v1/jobs").status_code == 200
        assert count + sum(map(len, pieces)) == size


SLOW = 45
"""Slow clients at once: more than the API has threads, and more than it has slots of the bucket."""


def test_slow_clients_hold_neither_threads_nor_slots(s3: FaultyS3, serve: Serve) -> None:
    """Downloads that nobody reads and uploads that stop half-way leave others to be served, and end whole."""
    app = serve(storage=f"{s3.storage}/{secrets.token_hex(8)}")
    job_id, capture_id = app.job(), app.capture()
    app.begin(job_id)
    app.finish(job_id)
    model = secrets.token_bytes(1 << 20) * 4
    app.service.storage.put(layout.model_file(job_id, "model.ply"), model)
    photo, host = secrets.token_bytes(200_000), "Host: localhost\r\n"
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(socket.create_connection(app.address)) for _ in range(2 * SLOW)]
        for client in clients:
            client.settimeout(60)
        reading, writing = clients[:SLOW], clients[SLOW:]
        for client in reading:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
            client.sendall(f"GET /v1/models/{job_id}/files/model.ply HTTP/1.0\r\n{host}\r\n".encode())
            assert client.recv(12, socket.MSG_PEEK).endswith(b" 200")
        for number, client in enumerate(writing):
            head = f"PUT /v1/captures/{capture_id}/images/{number}.jpg HTTP/1.0\r\n{host}"
            client.sendall(f"{head}Content-Length: {len(photo)}\r\n\r\n".encode() + photo[:100_000])
        assert app.http.get("/v1/jobs").status_code == 200
        assert app.http.get(f"/v1/captures/{capture_id}").status_code == 200
        assert app.http.put(f"/v1/captures/{capture_id}/images/quick.jpg", content=photo).status_code == 201
        for client in writing:
            client.sendall(photo[100_000:])
        assert all(b" 201 " in _rest(client).split(b"\r\n")[0] for client in writing)
        assert all(_rest(client).partition(b"\r\n\r\n")[2] == model for client in reading)
    for number in range(SLOW):
        stored = layout.capture_file(capture_id, Role.images, f"{number}.jpg")
        assert app.service.storage.get(stored) == photo


def _rest(client: socket.socket) -> bytes:
    """What a connection still brings."""
    pieces = []
    while piece := client.recv(1 << 16):
        pieces.append(piece)
    return b"".join(pieces)


def test_slots_are_refused_at_once_after_one_has_waited_in_vain() -> None:
    slots, end, begun = Slots(1, patience=0.05), threading.Event(), threading.Event()

    def hold() -> None:
        with slots.taken():
            begun.set()
            end.wait(20)

    holder = threading.Thread(target=hold)
    holder.start()
    begun.wait(20)
    with pytest.raises(NoSlot), slots.taken():
        pass
    slots._patience = 3600.0  # nobody waits as long as nothing has ended
    with pytest.raises(NoSlot), slots.taken():
        pass
    end.set()
    holder.join()
    with slots.taken():
        pass


def test_operations_beyond_the_slots_are_refused_and_later_ones_are_served(
    s3: FaultyS3, storage: Storage
) -> None:
    storage.put("file", b"bytes")
    s3.fault = lambda _: "stall"
    with ThreadPoolExecutor(SLOTS) as pool:
        waiting = [pool.submit(storage.get, "file") for _ in range(SLOTS)]
        wait_for(lambda: s3.stalled == SLOTS)
        with pytest.raises(StorageBusyError, match=f"{SLOTS} operations wait"):
            storage.get("file")
        s3.fault = lambda _: None
        s3.release()
        assert [task.result(20) for task in waiting] == [b"bytes"] * SLOTS
    assert storage.get("file") == b"bytes"


def test_a_storage_that_does_not_answer_leaves_jobs_to_be_listed_and_cancelled(
    s3: FaultyS3, serve: Serve
) -> None:
    app = serve(storage=f"{s3.storage}/{secrets.token_hex(8)}", api_key="s3cret")
    made = app.http.post("/v1/keys", json={"name": "ann's key", "owner": "ann"}).json()
    app.http.headers["Authorization"] = f"Bearer {made['secret']}"  # its record is in storage as well
    capture_id = app.capture()
    waiting, running = app.job(capture_id), app.job(capture_id)
    app.begin(running)
    s3.fault = lambda _: "stall"
    with ThreadPoolExecutor(60) as pool:
        looks = [pool.submit(app.http.get, f"/v1/captures/{capture_id}") for _ in range(60)]
        wait_for(lambda: s3.stalled >= SLOTS)
        listed = app.http.get("/v1/jobs").json()["jobs"]
        assert {job["id"] for job in listed} == {waiting, running}
        assert app.http.post(f"/v1/jobs/{waiting}/cancel").json()["state"] == "cancelled"
        assert app.http.post(f"/v1/jobs/{running}/cancel").json()["cancel_requested"] is True
        assert app.http.get(f"/v1/jobs/{waiting}/events").status_code == 200
        ready = app.http.get("/readyz")
        assert ready.status_code == 503
        assert s3.stalled >= SLOTS, "the requests above were answered while storage did not answer"
        refused = [look.result(20) for look in looks if look.done()]
        assert refused
        assert "operations as may wait for it" in problem(refused[0], 503, "storage_unavailable")["detail"]
        s3.fault = lambda _: None
        s3.release()
        answers = [look.result(20) for look in looks]
    assert {answer.status_code for answer in answers} <= {200, 503}
    assert app.http.get(f"/v1/captures/{capture_id}").status_code == 200
