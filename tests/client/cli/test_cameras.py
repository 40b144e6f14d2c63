"""Proves that `splatmill cameras` unpacks what a format needs of a model on a server or in a folder, and no more.

Does not prove what is in cameras.zip: tests/worker/sfm/posed/test_written.py does.
"""

import io
import zipfile
from datetime import UTC, datetime
from pathlib import Path

import pytest

from splatmill.backplane.storage import layout
from splatmill.schema import Job, JobState, TrainOptions
from tests.client.conftest import Service
from tests.support.ball import store_ball
from tests.support.command_line import invoke, spawn

COLMAP = {
    "cameras.bin": bytes.fromhex("0100000000000000010000000100000040000000000000003000000000000000")
    + bytes(32).replace(bytes(8), bytes.fromhex("0000000000004e40")),
    "images.bin": bytes(8),
    "points3D.bin": bytes(8),
}
"""A COLMAP model of one camera of 64 x 48 pixels, 60 of them its focal length, and of nothing else."""


def cameras_zip(**more: bytes) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, content in COLMAP.items():
            archive.writestr(f"sparse/0/{name}", content)
        for name, content in more.items():
            archive.writestr(name, content)
        archive.writestr("../outside.txt", b"never unpacked")
        archive.writestr("sparse/0/../../outside.txt", b"never unpacked")
    return data.getvalue()


FULL = cameras_zip(**{"transforms.json": b"{}", "points3D.ply": b"ply"})


def files_under(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize(
    ("chosen", "names"),
    [
        ("colmap", ["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"]),
        ("transforms", ["points3D.ply", "transforms.json"]),
    ],
)
def test_a_folder_gives_one_format(tmp_path: Path, chosen: str, names: list[str]) -> None:
    (tmp_path / "model").mkdir()
    (tmp_path / "model/cameras.zip").write_bytes(FULL)
    for model in ("model", "model/model.ply"):
        out = tmp_path / f"out-{Path(model).name}"
        done = invoke("cameras", tmp_path / model, "-o", out, "--format", chosen)
        assert done.exit_code == 0, done.output
        assert files_under(out) == names
        assert sorted(done.output.split()) == sorted(str(out / name) for name in names)


def test_a_model_on_a_server(service: Service, tmp_path: Path) -> None:
    store_ball(service.storage, tmp_path, "00000000000000aa", count=3)
    service.storage.put(layout.model_file("00000000000000aa", "cameras.zip"), FULL)
    job = Job(
        id="00000000000000aa",
        state=JobState.succeeded,
        capture="00000000000000bb",
        options=TrainOptions(),
        created_at=datetime.now(UTC),
    )
    service.storage.put(layout.job_record("00000000000000aa"), job.model_dump_json().encode())
    out = tmp_path / "out"
    done = invoke("cameras", "00000000000000aa", "-o", out, "--server", service.url)
    assert done.exit_code == 0, done.output
    assert files_under(out / "sparse/0") == sorted(COLMAP)


@pytest.mark.slow  # starts the worker's program
def test_text_is_made_by_colmap(tmp_path: Path) -> None:
    (tmp_path / "cameras.zip").write_bytes(cameras_zip())
    process = spawn("cameras", tmp_path, "-o", tmp_path / "out", "--format", "colmap-text")
    stdout, stderr = process.communicate(timeout=120)
    assert (process.returncode, stderr) == (0, "")
    printed = [Path(line).name for line in stdout.splitlines()]
    assert {"cameras.txt", "images.txt", "points3D.txt"} <= set(printed)
    assert files_under(tmp_path / "out/sparse/0") == sorted(printed)
    assert "PINHOLE 64 48 60 60 60 60" in (tmp_path / "out/sparse/0/cameras.txt").read_text()


def test_what_cannot_be_given_is_said(tmp_path: Path) -> None:
    for content, arguments, says in (
        (None, (), "There is no file"),
        (b"rubbish", (), "is no zip"),
        (cameras_zip(), ("--format", "transforms"), "has none of this format"),
    ):
        if content is not None:
            (tmp_path / "cameras.zip").write_bytes(content)
        done = invoke("cameras", tmp_path, "-o", tmp_path / "out", *arguments)
        assert done.exit_code == 2
        assert says in " ".join(done.output.replace("│", "").split())
