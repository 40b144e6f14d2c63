"""Proves that an archive is bounded as a whole: its ratio, the folders of its files, and its bytes; and so are
the frames of a video.

Does not prove the bounds of single files, names and links (test_images.py, tests/hostile), nor that what is unpacked
counts for an owner (tests/worker/service/test_room.py).
"""

from __future__ import annotations

import json
import os
import struct
import zipfile
import zlib
from pathlib import Path

import pytest

from splatmill_worker.errors import Refusal, UnusableVideo
from splatmill_worker.images import prepare
from splatmill_worker.images.archives import archive
from splatmill_worker.images.archives.archive import Allowance, UnsafeArchive, unpack
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.video import video
from tests.support.files import unmarked_zip
from tests.support.hostile import archives, pictures, videos


def written(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def zipped(folder: Path, files: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    place = folder / "set.zip"
    place.write_bytes(archives.packed(files, method))
    return place


def test_many_small_files_are_a_bomb_together(tmp_path: Path) -> None:
    place = tmp_path / "set.zip"
    place.write_bytes(archives.many_small())
    assert place.stat().st_size < 250_000
    with pytest.raises(UnsafeArchive, match=r"compressed \d{3} to 1 as a whole"):
        unpack(place, tmp_path / "target")
    assert written(tmp_path / "target") == 0


def test_texts_that_compress_well_are_unpacked(tmp_path: Path) -> None:
    lines = b"".join(b"%d %d 0.5 0.5 -1\n" % (n, n * 7919 % 4000) for n in range(20_000))
    place = zipped(tmp_path, {"sparse/0/images.txt": lines, "mask.bmp": bytes(2**20)})
    assert [path.stat().st_size for path in unpack(place, tmp_path / "target")] == [len(lines), 2**20]


def test_names_lead_through_a_bounded_number_of_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archive, "MAX_FOLDERS", 1000)
    files = {f"{n}/" + "a/" * 20 + "x.jpg": b"x" for n in range(50)}
    with pytest.raises(UnsafeArchive, match="more than 1000 folders"):
        unpack(zipped(tmp_path, files), tmp_path / "target")
    assert not (tmp_path / "target").exists()


def test_the_setting_bounds_what_a_capture_unpacks_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = zipped(tmp_path, {"a.jpg": os.urandom(50_000)}, zipfile.ZIP_STORED)
    monkeypatch.setenv("SPLATMILL_MAX_UNPACKED", "40kB")
    with pytest.raises(Refusal, match="40000 bytes"):
        unpack(place, tmp_path / "target")
    monkeypatch.setenv("SPLATMILL_MAX_UNPACKED", "60kB")
    allowance = Allowance()
    unpack(place, tmp_path / "target", allowance=allowance)
    assert allowance.bytes == 10_000


def test_frames_of_a_video_are_bounded_while_they_are_written_and_with_the_archives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = tmp_path / "images"
    images.mkdir()
    (images / "a.mp4").write_bytes(videos.video())
    monkeypatch.setenv("SPLATMILL_MAX_UNPACKED", "1kB")
    with pytest.raises(Refusal, match=r"With a\.mp4") as refused:
        prepare.prepare(images, None, tmp_path / "work", frames=4)
    assert refused.value.code == "archive_bomb"
    monkeypatch.setattr(video, "MAX_WRITTEN_BYTES", 1000)
    with pytest.raises(UnusableVideo, match="more than 1000 bytes as JPEGs"):
        decoders.keyframes(images / "a.mp4", tmp_path / "frames", 4)
    assert len(list((tmp_path / "frames").iterdir())) <= 2


def test_a_colon_in_a_name_refuses_no_zip(tmp_path: Path) -> None:
    place = zipped(tmp_path, {"x:1.jpg": b"1", " lead.jpg": b"2", "2.jpg": b"3"}, zipfile.ZIP_STORED)
    assert [path.name for path in unpack(place, tmp_path / "target")] == ["x:1.jpg", " lead.jpg", "2.jpg"]
    absolute = zipped(tmp_path, {"C:/1.jpg": b"1"}, zipfile.ZIP_STORED)
    with pytest.raises(UnsafeArchive, match="outside"):
        unpack(absolute, tmp_path / "other")


JAPANESE = ["images/写真00.jpg", "images/ソ表 01.jpg"]
CHINESE = ["images/房间/照片00.jpg", "images/房间/照片01.jpg"]
KOREAN = ["사진/방0.jpg", "사진/방1.jpg"]
RUSSIAN = ["images/Фото ёж 0.jpg", "images/Фото ёж 1.jpg"]


@pytest.mark.parametrize(
    ("names", "encoding", "label"),
    [
        (JAPANESE, "cp932", "cp932 (Japanese)"),
        (CHINESE, "gbk", "gb18030 (Chinese, simplified)"),
        (["images/照片房間0.jpg"], "cp950", "cp950 (Chinese, traditional)"),
        (KOREAN, "cp949", "cp949 (Korean)"),
        (RUSSIAN, "cp866", "cp866 (Russian)"),
        (RUSSIAN, "cp1251", "cp1251 (Russian, of Windows)"),
        (["Küche/Größe 1.jpg"], "cp850", "cp850 (Western European)"),
        (["Küche/Größe 1.jpg"], "cp1252", "cp1252 (Western European, of Windows)"),
        (JAPANESE, "utf-8", ""),
    ],
)
@pytest.mark.parametrize("form", ["sparse/0/images.txt", "transforms.json", "escaped", "none"])
def test_names_that_do_not_say_their_encoding(
    tmp_path: Path, names: list[str], encoding: str, label: str, form: str
) -> None:
    frames = {"frames": [{"file_path": f"./{name}"} for name in names]}
    cameras = {
        "sparse/0/images.txt": "".join(f"1 1 0 0 0 0 0 0 1 {name}\n\n" for name in names),
        "transforms.json": json.dumps(frames, ensure_ascii=False),
        "escaped": json.dumps(frames),
    }
    there = {} if form == "none" else {form.replace("escaped", "transforms.json"): cameras[form]}
    files = [(name.encode(), text.encode()) for name, text in there.items()]
    unmarked_zip.write(tmp_path / "set.zip", [*files, *((name.encode(encoding), b"x") for name in names)])
    written = unpack(tmp_path / "set.zip", tmp_path / "target")
    read = [path.relative_to(tmp_path / "target").as_posix() for path in written[len(there) :]]
    remark = " ".join(prepare.names_remark(tmp_path / "target"))
    if form == "none" and encoding in ("cp950", "cp1251", "cp1252"):
        assert "; as " in remark  # the bytes are words in several encodings
    else:
        assert read == names
        assert f"They are read as {label}: {names[0]}" in remark if label else remark == ""
        assert remark.endswith("as the cameras name them.") == (bool(label) and form != "none")


def test_the_name_in_the_extra_field_comes_first(tmp_path: Path) -> None:
    raw = [name.encode("cp932") for name in JAPANESE]
    named = [
        struct.pack("<BI", 1, zlib.crc32(old)) + name.encode() for old, name in zip(raw, CHINESE, strict=True)
    ]
    extra = [struct.pack("<HH", 0x7075, len(each)) + each for each in named]
    unmarked_zip.write(tmp_path / "set.zip", [(each, b"x") for each in raw], extra)
    written = unpack(tmp_path / "set.zip", tmp_path / "target")
    assert [path.relative_to(tmp_path / "target").as_posix() for path in written] == CHINESE
    assert prepare.names_remark(tmp_path / "target") == []
    renamed = [(each[:-1] + b"?", b"x") for each in raw]
    unmarked_zip.write(tmp_path / "stale.zip", renamed, extra)
    assert "?" in unpack(tmp_path / "stale.zip", tmp_path / "other")[0].name


def test_results_of_a_training_in_a_zip_are_no_photos(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    shots = {f"{number}.png": pictures.photo(number) for number in range(2)}
    results = {"splat/model.ply": b"ply", "splat/report.json": b"{}", "splat/preview.jpg": pictures.photo(2)}
    zipped(images, shots | results)
    prepared = prepare.prepare(images, None, tmp_path / "work")
    assert [photo.name for photo in prepared.photos] == ["set/0.png", "set/1.png"]
    assert ("set/splat/preview.jpg", "it is a result of Splatmill, not a photo") in prepared.skipped
