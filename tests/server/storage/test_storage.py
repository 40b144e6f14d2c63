"""Storage in a folder and in a bucket (moto's server): atomic writes, ranges, listing, and errors as sentences.

Not proved here: a bucket that fails (test_bucket), and other servers of the S3 protocol than moto's.
"""

import asyncio
import os
import secrets
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage, StorageError
from tests.support.servers.bucket import bucket


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    with bucket() as url:
        yield url


@pytest.fixture
def folder(tmp_path: Path) -> Storage:
    return Storage((tmp_path / "s").as_uri())


@pytest.fixture(params=["folder", "bucket"])
def storage(request: pytest.FixtureRequest) -> Storage:
    """An empty storage of each kind."""
    if request.param == "folder":
        return request.getfixturevalue("folder")  # type: ignore[no-any-return]  # pytest leaves it untyped
    return Storage(f"{request.getfixturevalue('s3')}/{secrets.token_hex(8)}")


def files(storage: Storage) -> list[str]:
    if storage.root is None:
        return [entry.path for entry in storage.entries("")]
    return sorted(str(p.relative_to(storage.root)) for p in storage.root.rglob("*") if p.is_file())


def test_what_is_put_is_read_listed_and_deleted(storage: Storage, tmp_path: Path) -> None:
    storage.put("a/b.bin", b"0123456789")
    (tmp_path / "local").write_bytes(b"x" * 3_000_000)
    storage.put("a/c.bin", tmp_path / "local")
    assert storage.get("a/b.bin") == b"0123456789"
    assert storage.get("a/b.bin", 2, 5) == b"234"
    assert storage.get("a/b.bin", 7) == b"789"
    assert [(e.path, e.size) for e in storage.entries("a")] == [("a/b.bin", 10), ("a/c.bin", 3_000_000)]
    assert storage.children("") == ["a"]
    head = storage.head("a/b.bin")
    assert head is not None
    assert head.etag
    storage.put("a/b.bin", b"other bytes")
    changed = storage.head("a/b.bin")
    assert changed is not None
    assert changed.etag != head.etag
    assert storage.delete_prefix("a") == 2
    assert storage.children("") == []
    assert storage.head("a/b.bin") is None
    storage.delete("a/b.bin")
    with pytest.raises(FileNotFoundError):
        storage.get("a/b.bin")


def test_only_the_first_of_two_new_files_is_stored(storage: Storage) -> None:
    assert storage.put_new("x", b"1")
    assert not storage.put_new("x", b"2")
    assert storage.get("x") == b"1"


def test_a_file_moves_with_its_bytes(storage: Storage) -> None:
    storage.put("incoming/token", b"bytes")
    storage.rename("incoming/token", "files/images/ü b.jpg")
    assert files(storage) == ["files/images/ü b.jpg"]
    assert storage.get("files/images/ü b.jpg") == b"bytes"
    with pytest.raises(FileNotFoundError):
        storage.rename("incoming/token", "other")


def test_a_walk_and_children_see_what_a_listing_sees(storage: Storage) -> None:
    paths = [f"captures/{'abc'[i % 3]}/files/{i:02}" for i in range(9)]
    for path in paths:
        storage.put(path, b"x")
    assert [entry.path for entry in storage.entries("captures")] == sorted(paths)
    assert {entry.path for entry in storage.walk("")} == set(paths)
    assert storage.children("captures") == ["a", "b", "c"]
    storage.check()
    assert len(files(storage)) == 9


def test_a_stream_that_breaks_leaves_nothing(storage: Storage) -> None:
    async def chunks(count: int, break_at: int | None = None) -> AsyncIterator[bytes]:
        for i in range(count):
            if i == break_at:
                raise RuntimeError("the line went dead")
            yield bytes([i]) * 5_000_000

    asyncio.run(storage.stream_put("whole", chunks(5)))
    for break_at in (0, 1, 4):
        with pytest.raises(RuntimeError, match="line went dead"):
            asyncio.run(storage.stream_put("broken", chunks(5, break_at)))
    assert files(storage) == ["whole"]

    async def read(start: int, end: int | None) -> bytes:
        return b"".join([piece async for piece in storage.stream_get("whole", start, end)])

    whole = storage.get("whole")
    assert len(whole) == 25_000_000
    assert asyncio.run(read(0, None)) == whole
    assert asyncio.run(read(4_999_999, 5_000_002)) == whole[4_999_999:5_000_002]
    assert asyncio.run(read(24_999_990, None)) == whole[-10:]


def test_a_failed_download_leaves_nothing(storage: Storage, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        storage.download("missing", tmp_path / "folder" / "file")
    assert list((tmp_path / "folder").iterdir()) == []


def test_errors_are_sentences_without_a_dump(folder: Storage) -> None:
    folder.put("file", b"x")
    with pytest.raises(StorageError) as caught:
        folder.put("file/below", b"x")
    text = str(caught.value)
    assert "could not write file/below" in text
    assert "\n" not in text
    assert "Debug source" not in text
    assert folder.get("file") == b"x"


@pytest.mark.parametrize(
    "text", ["", "..", "a/b", "UPPER000", "short", "a" * 41, "0123456789abcde\n", "../../etc/passwd"]
)
def test_only_ids_reach_paths(text: str) -> None:
    assert not layout.is_id(text)
    assert layout.is_id("0123456789abcdef")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become a user without the right to write")
def test_what_only_reads_needs_no_right_to_write(folder: Storage, tmp_path: Path) -> None:
    folder.put("models/a.ply", b"bytes")
    assert folder.root is not None
    for above in (tmp_path, *tmp_path.parents):
        if above.stat().st_mode & 0o077 == 0:
            above.chmod(0o755)  # pytest makes the folders that hold it for its user alone
    program = """
import os, sys
from splatmill.backplane.storage.storage import Storage, StorageError
os.setuid(65534)
try:
    Storage(sys.argv[1])
except StorageError as error:
    print(error)
print(Storage(sys.argv[1], read_only=True).get("models/a.ply"))
"""
    told = subprocess.run(
        [sys.executable, "-c", program, folder.url], capture_output=True, text=True, check=True
    )
    assert f"{folder.root} is not writable by this user" in told.stdout
    assert told.stdout.splitlines()[-1] == "b'bytes'"
