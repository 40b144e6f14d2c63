"""Proves that pictures, masks, videos and zips of strangers are refused by name before they cost memory or time.

The limits on memory are checked in a process of its own. What each of many more inputs is answered is proved in
tests/hostile.
"""

import resource
import subprocess
import sys
import threading
from pathlib import Path

import av
import pytest
from PIL import Image

from splatmill_worker import memory
from splatmill_worker.errors import Refusal, UnusablePicture, UnusableVideo
from splatmill_worker.images import decode, guarded
from splatmill_worker.images.archives import archive
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.prepare import prepare
from splatmill_worker.service.attempts.problems import problem_of
from tests.support.hostile import archives, pictures, videos
from tests.support.hostile.pictures import write


def code_of(path: Path) -> str:
    with pytest.raises(UnusablePicture) as caught:
        decode.decode(path)
    assert problem_of(caught.value).facts == {"file": path.name}
    return caught.value.code


@pytest.mark.parametrize("kind", ["GIF", "BMP", "PPM", "TGA", "ICO", "JPEG2000", "SGI", "PCX", "DDS"])
def test_formats_that_are_not_on_the_list_are_never_read(tmp_path: Path, kind: str) -> None:
    data = pictures.encoded(pictures.noise(), kind)
    assert code_of(write(tmp_path / "a.jpg", data)) == "not_an_image"


@pytest.mark.parametrize("data", [pictures.EPS, pictures.SVG, b"\x00" * 100, b"PK\x03\x04"])
def test_what_is_no_picture_is_called_so(tmp_path: Path, data: bytes) -> None:
    assert code_of(write(tmp_path / "a.jpg", data)) == "not_an_image"


def test_pictures_are_refused_by_their_header(tmp_path: Path) -> None:
    assert code_of(write(tmp_path / "a.png", pictures.png(30_000, 30_000, b""))) == "image_too_large"
    assert code_of(write(tmp_path / "a.tif", pictures.huge_tiff())) == "image_too_large"
    assert code_of(write(tmp_path / "text.png", pictures.text_bomb())) == "image_truncated"
    assert code_of(write(tmp_path / "empty.png", b"")) == "file_empty"
    assert code_of(write(tmp_path / "cut.jpg", pictures.photo()[:-600])) == "image_truncated"


def test_a_file_larger_than_the_limit_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "a.webp").open("wb") as file:
        file.write(pictures.encoded(pictures.noise(), "WEBP"))
        file.truncate(guarded.MAX_PICTURE_BYTES + 1)
    assert code_of(tmp_path / "a.webp") == "image_too_large"


BOMB_UNDER_LIMIT = """
import resource, sys
from pathlib import Path
from splatmill_worker.images.prepare import prepare
from splatmill_worker.errors import Refusal
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
folder = Path(sys.argv[1])
try:
    prepare(folder / "images", folder / "masks", folder / "work")
except Refusal as refusal:
    print(refusal.code, refusal.message)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


def test_a_mask_of_675_megapixels_is_refused_by_name_in_little_memory(tmp_path: Path) -> None:
    write(tmp_path / "images/a.jpg", pictures.encoded(pictures.noise(270, 250), "JPEG"))
    write(tmp_path / "masks/a.png", pictures.bomb())
    assert (tmp_path / "masks/a.png").stat().st_size < 120_000
    done = subprocess.run(
        [sys.executable, "-c", BOMB_UNDER_LIMIT, str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (60, 60)),
    )
    said, kilobytes = done.stdout.strip().splitlines()
    assert said.startswith("image_too_large masks/a.png: it has 27000 x 25000 pixels")
    assert int(kilobytes) < 50_000  # decoded, it has 675 MB


def test_a_mask_much_larger_than_its_photo_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatmill_worker.images.masks.MIN_SCALED_PIXELS", 100_000)
    write(tmp_path / "images/a.jpg", pictures.photo())
    write(tmp_path / "masks/a.png", pictures.encoded(Image.new("1", (640, 480)), "PNG"))
    with pytest.raises(UnusablePicture, match=r"masks/a.png: it has 640 x 480 pixels, more than 8 times"):
        prepare(tmp_path / "images", tmp_path / "masks", tmp_path / "work")


@pytest.mark.filterwarnings("ignore")  # Pillow says that the tags are damaged
def test_damaged_exif_leaves_the_photo_usable(tmp_path: Path) -> None:
    write(tmp_path / "a.jpg", pictures.with_exif(pictures.turned_with_rubbish()))
    result = prepare(tmp_path, None, tmp_path.with_name("work"))
    assert [(photo.width, photo.height) for photo in result.photos] == [(48, 64)]
    assert decode.decode(tmp_path / "a.jpg").size == (48, 64)


def test_of_several_pictures_in_a_file_the_first_is_used_and_a_note_says_so(tmp_path: Path) -> None:
    firsts = [pictures.noise(seed=seed) for seed in (1, 3, 4)]
    second = pictures.noise(64, 48, seed=2)
    for first, name, form in zip(firsts, ("a.webp", "b.tif", "c.png"), ("WEBP", "TIFF", "PNG"), strict=True):
        data = pictures.encoded(first, form, save_all=True, append_images=[second])
        write(tmp_path / name, data)
    result = prepare(tmp_path, None, tmp_path.with_name("work"))
    assert len(result.photos) == 3
    assert result.notes == tuple(
        f"{n} holds several pictures; the first one is used." for n in ("a.webp", "b.tif", "c.png")
    )
    assert decode.decode(tmp_path / "b.tif").tobytes() == firsts[1].tobytes()


def test_decoding_waits_for_room() -> None:
    space = guarded._Room(100)
    order: list[str] = []
    with space.taken(90):
        waiting = threading.Thread(target=lambda: enter("large", 1000))
        small = threading.Thread(target=lambda: enter("small", 10))

        def enter(name: str, pixels: int) -> None:
            with space.taken(pixels):
                order.append(name)

        waiting.start()
        small.start()
        small.join(60)
        assert order == ["small"]
    waiting.join(60)
    assert order == ["small", "large"]


def test_the_memory_for_decoding_is_a_part_of_the_containers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "_ROOT", tmp_path)
    everything = guarded.decoding_pixels()
    write(tmp_path / "proc/self/cgroup", b"0::/\n")
    write(tmp_path / "sys/fs/cgroup/memory.max", b"%d\n" % 2**30)
    assert guarded.decoding_pixels() == 2**30 // 16 < everything


@pytest.mark.parametrize("data", [videos.PLAYLIST, videos.CONCAT, b"x" * 5000, videos.video()[:300]])
def test_what_is_no_video_of_the_list_opens_nothing_else(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(UnusableVideo, match=r"walk\.mp4: it does not decode as an MP4, MOV") as error:
        decoders.keyframes(write(tmp_path / "walk.mp4", data), tmp_path / "out", 4)
    assert str(tmp_path) not in str(error.value)
    assert "Errno" not in str(error.value)


@pytest.mark.parametrize("form", ["mpegts", "flv", "nut"])
def test_containers_that_are_not_on_the_list_are_not_read(tmp_path: Path, form: str) -> None:
    data = videos.video(form)
    with pytest.raises(UnusableVideo):
        decoders.keyframes(write(tmp_path / "walk.mp4", data), tmp_path / "out", 4)


def test_a_video_without_length_is_measured(tmp_path: Path) -> None:
    with av.open(str(write(tmp_path / "walk.webm", videos.without_length()))) as container:
        assert container.duration is None
    assert len(decoders.keyframes(tmp_path / "walk.webm", tmp_path / "out", 4)) == 4


def test_frames_larger_than_8k_are_refused_before_one_is_decoded(tmp_path: Path) -> None:
    path = write(tmp_path / "walk.avi", videos.larger_than_8k())
    with pytest.raises(UnusableVideo, match="35 million"):
        decoders.keyframes(path, tmp_path / "out", 4)


@pytest.mark.parametrize(
    ("limit", "value", "said"),
    [
        ("MAX_VIDEO_SECONDS", 1.0, "seconds long"),
        ("MAX_VIDEO_FRAMES", 5, "frames"),
        ("MAX_READING_SECONDS", -1.0, "took longer"),
    ],
)
def test_the_limits_of_a_video_name_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, value: float, said: str
) -> None:
    monkeypatch.setattr(guarded, limit, value)
    with pytest.raises(UnusableVideo, match=said):
        decoders.keyframes(write(tmp_path / "walk.mp4", videos.video()), tmp_path / "out", 4)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (archives.overlapping(), "overlaps"),
        (archives.with_entries(100_000), "list of files"),
        (archives.encrypted(), "encrypted"),
        (archives.wrong_checksum(), "damaged or cut off"),
        (archives.packed({"a.jpg": pictures.photo()})[:-30], "not a complete zip"),
        (
            archives.packed({"a.jpg": pictures.photo()}).replace(b"a.jpg", b"\0.jpg"),
            "the name '' is not a file name",
        ),
        (archives.packed({"a": b"1", "a/b.jpg": pictures.photo()}), "name 'a/b.jpg'"),
        (archives.packed({"a/b.jpg": pictures.photo(), "a": b"1"}), "name 'a'"),
        (archives.packed({"a" * 300 + ".jpg": pictures.photo()}), "too long"),
        (archives.packed({"d/" * 3000 + "a.jpg": pictures.photo()}), "too long"),
    ],
)
def test_zips_that_cheat_are_refused(tmp_path: Path, data: bytes, said: str) -> None:
    with pytest.raises(archive.UnsafeArchive, match=said):
        archive.unpack(write(tmp_path / "a.zip", data), tmp_path / "out")


def test_all_archives_of_a_capture_share_one_allowance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = {f"{k}.jpg": pictures.photo(k) for k in range(3)}
    for name in ("a.zip", "b.zip"):
        write(tmp_path / "images" / name, archives.packed({name + key: files[key] for key in files}))
    monkeypatch.setattr(archive.Allowance.__init__, "__defaults__", (4, 2**20))
    for attempt in ("first", "again, with what the first has unpacked"):
        with pytest.raises(Refusal, match=r"With b\.zip") as caught:
            prepare(tmp_path / "images", None, tmp_path / "work")
        assert caught.value.code == "archive_bomb", attempt
    assert len(list((tmp_path / "work").rglob("*.jpg"))) == 3
