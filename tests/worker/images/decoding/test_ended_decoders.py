"""Decoding processes that are ended at any moment, and answers of one that a file has taken over.

A kill of the kernel for want of memory, of an operator or of a fault in a library are one SIGKILL here. Each moment is
met exactly; `tests/service/test_soak.py` ends a process of a true job at a random one.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatmill.schema import TrainOptions
from splatmill_worker import pipeline, synthetic
from splatmill_worker.errors import Cancelled, DecoderNotStarted, Refusal, UnusablePicture, UnusableVideo
from splatmill_worker.images import decode as here
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.decoding.decoder import LENGTHS
from splatmill_worker.images.decoding.decoder_process import Call, DecoderProcess
from splatmill_worker.images.decoding.decoders import STARTS, Decoders, confined
from splatmill_worker.images.decoding.turns import Turns
from splatmill_worker.images.prepare import prepare
from splatmill_worker.images.video import video as video_here
from splatmill_worker.readers import reader_memory
from splatmill_worker.service.attempts.problems import is_transient, keeps_progress, problem_of
from splatmill_worker.sfm import posed
from tests.support import posed_sets
from tests.support.decoding.acting import acts, children
from tests.support.hostile.videos import video

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the moments are those of processes of Linux")


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A folder with four different photos."""
    folder = tmp_path / "job" / "photos"
    folder.mkdir(parents=True)
    random = np.random.default_rng(6)
    for name in "abcd":
        Image.fromarray(random.integers(0, 256, (96, 160, 3), np.uint8)).save(folder / f"{name}.png")
    return folder


@pytest.fixture
def confinement(photos: Path, tmp_path: Path) -> Iterator[Decoders]:
    with confined([tmp_path / "job"], tmp_path / "ended.json") as started:
        yield started


def kill(process: DecoderProcess) -> None:
    """Kill a process, and wait until it has ended, without reaping it."""
    pid = process._process.pid
    os.kill(pid, signal.SIGKILL)
    os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)


class Killer:
    """Kills the process at the first `times` calls of one of its methods: before it, or between stop and call."""

    def __init__(self, patch: pytest.MonkeyPatch, method: str, times: int, *, after: bool = False) -> None:
        self.calls = 0
        original: Callable[..., Any] = getattr(DecoderProcess, method)

        def killing(process: DecoderProcess, *arguments: Any) -> Any:
            self.calls += 1
            if self.calls > times:
                return original(process, *arguments)
            if not after:
                kill(process)
                return original(process, *arguments)
            os.kill(process._process.pid, signal.SIGSTOP)  # it cannot answer before it is killed
            result = original(process, *arguments)
            kill(process)
            return result

        patch.setattr(DecoderProcess, method, killing)


def same(path: Path) -> bool:
    return np.array_equal(np.asarray(decoders.decode(path)), np.asarray(here.decode(path)))


@pytest.mark.parametrize("method", ["ready", "runs", "ask"])
def test_one_end_is_not_noticed_by_the_caller(
    method: str, photos: Path, confinement: Decoders, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the start, while it waits for a call, and when the call is written, which is then a broken pipe."""
    assert same(photos / "a.png")
    killer = Killer(monkeypatch, method, 1)
    assert same(photos / "b.png")
    assert killer.calls >= 1
    assert same(photos / "c.png")


def test_an_end_between_call_and_answer_gives_a_second_try(
    photos: Path, confinement: Decoders, monkeypatch: pytest.MonkeyPatch
) -> None:
    confinement.ready()
    killer = Killer(monkeypatch, "_send", 1, after=True)
    assert same(photos / "a.png")
    assert killer.calls > 1


def test_an_end_within_an_answer_gives_a_second_try(
    photos: Path, confinement: Decoders, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer is longer than the pipe, so that a part of it never comes."""
    big = photos / "big.png"
    Image.fromarray(np.random.default_rng(7).integers(0, 256, (1800, 1600), np.uint8)).save(big)
    killed = 0
    original = DecoderProcess._read

    def read(process: DecoderProcess, length: int, *arguments: Any) -> Any:
        nonlocal killed
        if length > 2**21 and not killed:
            killed += 1
            kill(process)
        return original(process, length, *arguments)

    monkeypatch.setattr(DecoderProcess, "_read", read)
    assert same(big)
    assert killed == 1


def test_a_photo_that_ends_its_process_twice_is_left_out_by_name(
    photos: Path, confinement: Decoders, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    confinement.ready()
    with monkeypatch.context() as patch:
        killer = Killer(patch, "ask", 2)
        with pytest.raises(UnusablePicture) as caught:
            decoders.decode(photos / "b.png")
        assert killer.calls == 2
    assert caught.value.code == "decoder_ended"
    assert "b.png: it could not be decoded: its decoder was ended twice (signal 9)" in str(caught.value)
    assert is_transient(caught.value)
    assert keeps_progress(caught.value)
    assert problem_of(caught.value).code == "decoder_ended"
    prepared = prepare(photos, None, tmp_path / "work")
    assert [photo.name for photo in prepared.photos] == ["a.png", "c.png", "d.png"]
    assert prepared.skipped == (("b.png", "it could not be decoded: its decoder was ended twice (signal 9)"),)


def test_the_next_attempt_does_not_open_it_again(photos: Path, tmp_path: Path) -> None:
    kept = tmp_path / "ended.json"
    kept.write_text(json.dumps({"photos/b.png": "it could not be decoded: its decoder was ended twice"}))
    with confined([tmp_path / "job"], kept):
        prepared = prepare(photos, None, tmp_path / "work")
        assert [name for name, _ in prepared.skipped] == ["b.png"]
        assert decoders.forget_ended()
        assert len(prepare(photos, None, tmp_path / "work").photos) == 4
    # The list is written anew and not removed: its copy in storage is replaced by this one.
    assert json.loads(kept.read_text()) == {}


def test_a_damaged_list_of_ended_files_is_none(photos: Path, tmp_path: Path) -> None:
    kept = tmp_path / "ended.json"
    kept.write_text('["no list"')
    with confined([tmp_path / "job"], kept):
        assert same(photos / "a.png")


def test_where_no_photo_is_left_the_job_is_tried_again(
    photos: Path, confinement: Decoders, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever ends the process of every photo has nothing to do with photos."""
    for name in "cd":
        (photos / f"{name}.png").unlink()
    with monkeypatch.context() as patch:
        Killer(patch, "ask", 1000)
        with pytest.raises(UnusablePicture, match="no photo is left") as caught:
            prepare(photos, None, tmp_path / "work")
    assert is_transient(caught.value)
    assert len(prepare(photos, None, tmp_path / "work").photos) == 2


def test_photos_with_cameras_are_left_out_and_the_job_is_tried_again_likewise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = tmp_path / "capture"
    posed_sets.photos(capture / "images", ["0.png", "1.png"])
    posed_sets.transforms(capture / "transforms.json", posed_sets.frames(["0.png", "1.png"]))
    poses = posed.find(capture)
    assert poses is not None
    with confined([capture]):
        with monkeypatch.context() as patch:
            Killer(patch, "ask", 2)
            scene = poses.load()
            assert [view.name for view in scene.views] == ["1.png"]
            assert "ended twice" in dict(scene.left_out)["0.png"]
        with monkeypatch.context() as patch:
            Killer(patch, "ask", 1000)
            with pytest.raises(UnusablePicture, match="no photo is left") as caught:
                poses.load()
            assert is_transient(caught.value)
        assert len(poses.load().views) == 2


@pytest.mark.slow
def test_a_photo_that_ends_its_process_when_it_is_loaded_is_left_out_by_the_next_attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its header is whole, so that it is known only when the photos to train on are loaded."""
    cameras = synthetic.capture(tmp_path / "photos", 8, 96, 72)
    capture, work, kept = tmp_path / "capture", tmp_path / "work", tmp_path / "ended.json"
    capture.mkdir()
    (tmp_path / "photos").rename(capture / "images")
    (capture / "transforms.json").write_text(json.dumps(posed_sets.document(cameras)))
    bad = sorted(cameras)[3]
    original = DecoderProcess.ask

    def ask(process: DecoderProcess, asked: Call) -> Any:
        if asked.function is here.pixels and asked.path.name == bad:
            kill(process)
        return original(process, asked)

    monkeypatch.setattr(DecoderProcess, "ask", ask)
    said: list[Any] = []
    options = TrainOptions(steps=5, max_gaussians=500, holdout=0, image_size=48)

    def attempt() -> str:
        with confined([tmp_path], kept):
            return pipeline.run(capture, work, options, said.append, lambda: False).ended

    with pytest.raises(UnusablePicture, match=bad) as caught:
        attempt()
    assert is_transient(caught.value)
    assert attempt() == "succeeded"
    assert any(bad in str(event) and "ended twice" in str(event) for event in said)
    written = json.loads((work / "out" / "cameras.json").read_text())
    assert sorted(row["name"] for row in written["cameras"]) == sorted(set(cameras) - {bad})


def test_a_photo_is_left_out_if_its_mask_ends_the_process_twice(
    photos: Path, confinement: Decoders, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Training on it without the mask would give another scene."""
    masks = tmp_path / "job" / "masks"
    masks.mkdir()
    Image.new("L", (160, 96), 255).save(masks / "a.png")
    original = decoders.mask_fault

    def fault(mask: Path, *arguments: Any) -> str | None:
        with monkeypatch.context() as patch:
            Killer(patch, "ask", 2)
            return original(mask, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(decoders, "mask_fault", fault)
        patch.setattr("splatmill_worker.images.prepare.ThreadPoolExecutor", OneByOne)
        prepared = prepare(photos, masks, tmp_path / "work")
    assert [photo.name for photo in prepared.photos] == ["b.png", "c.png", "d.png"]
    assert "of its mask" in dict(prepared.skipped)["a.png"]


class OneByOne:
    """A pool that calls when it is asked for the result, so that no other call is under way."""

    def __init__(self, threads: int) -> None: ...

    def __enter__(self) -> OneByOne:
        return self

    def __exit__(self, *error: object) -> None: ...

    def map(self, function: Callable[[Any], Any], items: Any) -> Iterator[Any]:
        return map(function, items)


def test_a_video_is_begun_anew(photos: Path, confinement: Decoders, tmp_path: Path) -> None:
    (photos / "walk.mp4").write_bytes(video(frames=40))
    frames = dict(video_here.keyframes(photos / "walk.mp4", 6))
    written: list[tuple[int, bytes]] = []

    def write(number: int, picture: bytes) -> None:
        written.append((number, picture))
        if len(written) == 2:
            for pid in children():
                os.kill(pid, signal.SIGKILL)

    confinement.keyframes(photos / "walk.mp4", 6, write, lambda: False)
    assert dict(written) == frames
    assert len(written) >= len(frames)


def test_a_video_that_ends_its_process_twice_is_left_out(
    photos: Path, confinement: Decoders, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (photos / "walk.mp4").write_bytes(video())
    with monkeypatch.context() as patch:
        Killer(patch, "ask", 2)
        with pytest.raises(UnusableVideo, match=r"ended twice \(signal 9\)"):
            decoders.keyframes(photos / "walk.mp4", tmp_path / "out", 3)
    prepared = prepare(photos, None, tmp_path / "work")
    assert [name for name, _ in prepared.skipped] == ["walk.mp4"]


def test_points_whose_reader_is_ended_twice_end_the_attempt_and_not_the_points(
    photos: Path, confinement: Decoders, monkeypatch: pytest.MonkeyPatch
) -> None:
    (photos / "images").mkdir()
    (photos / "a.png").rename(photos / "images" / "a.png")
    (photos / "poses").mkdir()
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    document = {"camera_angle_x": 1.0, "ply_file_path": "points.ply", "frames": [frame]}
    (photos / "poses" / "transforms.json").write_text(json.dumps(document))
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat ascii 1.0\nelement vertex 1\n{axes}end_header\n"
    (photos / "poses" / "points.ply").write_text(header + "1 2 3\n")
    poses = posed.find(photos)
    assert poses is not None
    assert len(poses.load().points) == 1
    original = decoders.call_once

    def killed(*arguments: Any, **options: Any) -> Any:
        with monkeypatch.context() as patch:
            Killer(patch, "ask", 1000)
            return original(*arguments, **options)

    monkeypatch.setattr(decoders, "call_once", killed)
    with pytest.raises(Refusal, match="ended twice") as caught:
        poses.load()
    assert is_transient(caught.value)


def test_a_process_that_never_starts_says_why_and_the_job_is_tried_again(
    photos: Path, confinement: Decoders, monkeypatch: pytest.MonkeyPatch
) -> None:
    killer = Killer(monkeypatch, "ready", 1000)
    with pytest.raises(DecoderNotStarted, match="could be started: signal 9") as caught:
        decoders.decode(photos / "a.png")
    assert killer.calls == STARTS
    assert is_transient(caught.value)
    assert problem_of(caught.value).code == "decoder_ended"


def test_why_it_does_not_start_is_its_last_line(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "splatmill_worker.images.decoding.decoder_process._COMMAND",
        (sys.executable, "-c", "import no_such_part"),
    )
    with (
        confined([photos]),
        pytest.raises(DecoderNotStarted, match="exit status 1: ModuleNotFoundError: No module named"),
    ):
        decoders.decode(photos / "a.png")
    monkeypatch.setattr("splatmill_worker.images.decoding.decoder_process._COMMAND", ("/no/such/program",))
    with confined([photos]), pytest.raises(DecoderNotStarted, match="No such file"):
        decoders.decode(photos / "a.png")


def test_a_process_that_is_not_ready_in_time_is_started_once(
    photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten such waits would take most of an hour."""
    starts: list[DecoderProcess] = []
    original = DecoderProcess.ready

    def ready(process: DecoderProcess) -> tuple[str, ...]:
        starts.append(process)
        return original(process)

    program = "import sys; sys.stdin.read()  # images.decoding.decoder"
    monkeypatch.setattr(
        "splatmill_worker.images.decoding.decoder_process._COMMAND", (sys.executable, "-c", program)
    )
    monkeypatch.setattr("splatmill_worker.images.decoding.decoder_process.PICTURE_SECONDS", 0.5)
    monkeypatch.setattr(DecoderProcess, "ready", ready)
    with confined([photos]):
        with pytest.raises(DecoderNotStarted, match="it was not ready after"):
            decoders.decode(photos / "a.png")
        assert children() == []
    assert len(starts) == 1


def test_processes_that_have_ended_do_not_disturb_the_end(photos: Path) -> None:
    with confined([photos]):
        assert same(photos / "a.png")
        for pid in children():
            os.kill(pid, signal.SIGKILL)
    assert children() == []


def test_the_second_try_runs_alone() -> None:
    """It may have been ended for want of memory, which other photos took."""
    turns = Turns()
    order: list[str] = []
    entered = threading.Event()

    def second() -> None:
        with turns.taken(alone=True):
            order.append("alone")

    def third() -> None:
        with turns.taken(alone=False):
            order.append("after")

    with turns.taken(alone=False):
        alone = threading.Thread(target=second)
        alone.start()
        while not turns._alone:
            entered.wait(0.001)
        after = threading.Thread(target=third)
        after.start()
        assert order == []
        order.append("before")
    alone.join()
    after.join()
    assert order == ["before", "alone", "after"]


def told(value: Any, arrays: bytes = b"") -> bytes:
    text = json.dumps(value).encode()
    return LENGTHS.pack(len(text), len(arrays)) + text + arrays


ANSWERS = (
    told({"value": {"": ["|u1", [10**9, 10**9]]}}),
    told({"value": {"": ["|u1", [-1, 5]]}}),
    told({"value": {"": ["|u1", [1.5]]}}),
    told({"value": {"": ["|O8", [1]]}}, bytes(8)),
    told({"value": {"": ["V8", [1]]}}, bytes(8)),
    told({"value": {"": ["|u1", [4]]}}, bytes(9)),
    told({"value": {"": ["<f4", [2, 2]]}}, bytes(16)),
    told({"value": {"": ["|u1", [2, 2, 2]]}}, bytes(8)),
    told({"value": {"": "no array"}}),
    told({"value": "no array"}),
    told({"value": {"": ["|u1", [0, 0]]}}),
    told({"other": 1}),
    told([1, 2]),
    told({"error": "no description"}),
    told({"error": {"name": "picture", "given": []}}),
    told({"error": {"name": "picture", "given": ["no_such_code", "a", "b"]}}),
    told({"error": {"name": "system", "given": ["x"]}}),
    told({"error": {"name": "system", "given": [float("inf"), "a", "b"]}}),
    told({"value": {"": ["|u1", [0, 10**30]]}}),
    told({"part": 1}) * 2 + told({"value": 1}),
    LENGTHS.pack(2**40, 0),
    LENGTHS.pack(2, 2**40),
    LENGTHS.pack(4, 0) + b"{{{{",
    LENGTHS.pack(2**17, 0) + b"[" * 2**17,
)
"""Answers that no function of this package gives."""


@pytest.mark.slow
def test_an_answer_that_is_none_costs_the_file(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of them costs its own file alone: another process reads the next one."""
    known = acts(monkeypatch)

    def refused(answer: bytes) -> bool:
        try:
            decoders.call(known.answer, photos / "a.png", answer.hex(), check=here.picture_of)
        except UnusablePicture as error:
            return "a.png: its decoder gave an answer that is not valid" in str(error)
        return False

    with confined([photos]):
        for answer in ANSWERS:
            assert refused(answer), answer[:200]
            assert same(photos / "b.png"), answer[:200]


@pytest.mark.parametrize(
    ("first", "again"),
    [(LENGTHS.pack(10, 10**6), b"x"), (b"", told({"part": 1}))],
    ids=["an answer, byte by byte", "parts"],
)
def test_answers_that_never_end_are_given_up(
    first: bytes, again: bytes, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = acts(monkeypatch)
    with confined([photos]) as started:
        with pytest.raises(UnusablePicture, match="decoding it took longer than 1 seconds"):
            decoders.call(
                known.endless, photos / "a.png", first.hex(), again.hex(), check=here.picture_of, seconds=1.0
            )
        cancelled = iter((False, False, True))
        asked = Call(
            known.endless, photos / "a.png", (first.hex(), again.hex()), cancelled=lambda: next(cancelled)
        )
        with pytest.raises(Cancelled):
            started.call(asked, here.picture_of, UnusablePicture)


@pytest.mark.parametrize("check", [here.picture_of, lambda value: value.shape, lambda value: value[7]])
def test_a_process_whose_answer_is_not_valid_reads_no_other_file(
    check: Callable[[Any], Any], photos: Path, confinement: Decoders
) -> None:
    """A file may have taken it over, and would answer for the others, too."""
    assert same(photos / "a.png")
    (before,) = children()
    with pytest.raises(UnusablePicture, match=r"b.png: its decoder gave an answer that is not valid"):
        decoders.call(here.sizes, photos / "b.png", "b.png", check=check)
    assert before not in children()
    assert same(photos / "c.png")


def test_a_reader_cannot_make_the_attempt_take_all_memory(
    photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = acts(monkeypatch)
    monkeypatch.setattr(reader_memory, "_limit", 2**30)
    announced = LENGTHS.pack(2, 2**29) + b"{}"
    with confined([photos]), pytest.raises(UnusablePicture, match="an answer that is not valid"):
        decoders.call_once(
            known.answer, photos / "a.png", announced.hex(), check=here.picture_of, fault=UnusablePicture
        )


def test_a_reader_ends_with_the_attempt(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = acts(monkeypatch)
    asked = itertools.count()
    with confined([photos], cancelled=lambda: next(asked) > 0), pytest.raises(Cancelled):
        decoders.call_once(
            known.endless, photos / "a.png", "", "", check=here.picture_of, fault=UnusablePicture
        )
    assert children() == []


def test_a_kept_reader_reads_all_models_until_a_file_ends_it(
    photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another file under the name of the one that ended it twice is read by the next one."""

    def read() -> Any:
        return decoders.call_once(
            here.sizes, photos / "a.png", "a.png", check=lambda value: value, fault=UnusablePicture
        )

    with confined([photos], keep_reader=True):
        assert read()[0] == [160, 96]
        kept = children()
        assert len(kept) == 2
        assert read()[0] == [160, 96]
        assert children() == kept
        with monkeypatch.context() as patch:
            Killer(patch, "ask", 2)
            with pytest.raises(UnusablePicture, match="ended twice"):
                read()
        assert read()[0] == [160, 96]
        assert children() != kept
    assert children() == []


def test_what_a_function_raises_costs_no_process(photos: Path, confinement: Decoders) -> None:
    assert same(photos / "a.png")
    before = children()
    (photos / "b.png").write_bytes(b"no picture")
    with pytest.raises(UnusablePicture, match="not an image"):
        decoders.decode(photos / "b.png")
    with pytest.raises(FileNotFoundError):
        decoders.decode(photos / "none.png")
    assert children() == before


def test_a_first_answer_that_is_not_valid_is_no_fault_of_the_file(
    photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = "import os, sys; os.write(1, b'x' * 64); sys.stdin.read()  # images.decoding.decoder"
    monkeypatch.setattr(
        "splatmill_worker.images.decoding.decoder_process._COMMAND", (sys.executable, "-c", program)
    )
    with confined([photos]):
        with pytest.raises(DecoderNotStarted, match="its first answer is not valid"):
            decoders.decode(photos / "a.png")
        assert children() == []


def test_what_a_decoder_says_of_a_file_is_cut(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = acts(monkeypatch)
    long = told({"error": {"name": "picture", "given": ["image_truncated", "a" * 9000, "b" * 9000]}})
    with confined([photos]), pytest.raises(UnusablePicture) as caught:
        decoders.call(known.answer, photos / "a.png", long.hex(), check=here.picture_of)
    assert len(str(caught.value)) < 2500
