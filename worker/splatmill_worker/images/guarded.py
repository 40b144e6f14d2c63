"""The one place where pictures and videos of strangers are opened, and the limits that hold for all of them.

A picture is opened by its header alone: the format must be one of FORMATS, the file and the picture within the limits.
Nothing is decoded before that. A video is opened by FFmpeg with few of its demuxers, so that no playlist, script or
image list can name other files or addresses.

`tests/test_architecture.py` forbids other calls of `Image.open` and `av.open`.
"""

from __future__ import annotations

import fcntl
import io
import os
import struct
import threading
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pillow_heif
from PIL import Image, UnidentifiedImageError

from splatmill.schema.files.photos import MAX_PHOTO_PIXELS, PHOTO_FORMATS, VIDEO_FORMATS
from splatmill_worker import memory
from splatmill_worker.errors import UnusablePicture, UnusableVideo
from splatmill_worker.images.signatures import recognised
from splatmill_worker.wording import plain

if TYPE_CHECKING:
    import av

pillow_heif.register_heif_opener()

FORMATS = tuple(PHOTO_FORMATS)
"""Pillow's names of the formats that are read. Its other readers, some of which start programs, are never called."""

AVIF_BRANDS = (b"avif", b"avis")
"""Major brands of AVIF: a picture and a sequence of pictures."""

MAX_PICTURE_BYTES = 2 * 2**30
"""Bytes of a picture's file: some readers take the whole file into memory."""

CONTAINERS = ",".join(VIDEO_FORMATS)
"""FFmpeg's names of the video containers that are read, for its option."""

MAX_FRAME_PIXELS = 8192 * 4320
"""Pixels of a video's frame: 8K as cinemas have it."""

MAX_VIDEO_SECONDS = 4 * 3600.0
"""Length of a video."""

MAX_VIDEO_FRAMES = 1_000_000
"""Frames of a video: more than four hours at 60 frames per second."""

MAX_READING_SECONDS = 3600.0
"""Wall time that one pass over a video may take. Two are made: to choose frames, and to write them."""

MAX_CHUNKS = 100
"""Chunks of a PNG before its pixels that are looked through."""

UNSPECIFIED = 2
"""The code of H.273 for primaries, transfer function and matrix that a file does not name."""

UNKNOWN = "it is not an image, or its format is not supported"
"""Of a file whose first bytes say nothing."""

_BYTES_PER_PIXEL = 4
DECODE_ERRORS = (
    *(
        OSError,
        ValueError,
        SyntaxError,
        EOFError,
        IndexError,
        KeyError,
        TypeError,
        OverflowError,
        RuntimeError,
    ),
    *(struct.error, zlib.error),
)
"""What Pillow and its readers raise for damaged files."""

# The limit of pixels is checked below. Pillow's own allows twice as many, and only warns before that.
Image.MAX_IMAGE_PIXELS = None


@contextmanager
def opened(path: Path, name: str | None = None) -> Iterator[Image.Image]:
    """Open a picture by its header; `decode.whole` decodes it. Errors call it `name`, or else by its file name.

    Raises UnusablePicture when it is empty, of another format, too large, or has a damaged header, and OSError when the
    operating system cannot open the file.
    """
    name = name or path.name
    with damage(name, "its header cannot be read"):
        image = _opened(path, name)
    with image:
        _check_pixels(image, name)
        yield image


@contextmanager
def opened_bytes(data: bytes, name: str, formats: tuple[str, ...]) -> Iterator[Image.Image]:
    """Open a picture of one of Pillow's `formats` that is a part of another file; errors call it `name`.

    Raises UnusablePicture when it is of another format, too large, or has a damaged header.
    """
    with damage(name, "its header cannot be read"):
        try:
            image = Image.open(io.BytesIO(data), formats=formats)
        except UnidentifiedImageError as error:
            raise UnusablePicture(
                "not_an_image", name, f"it is not a picture of the format {' or '.join(formats)}"
            ) from error
    with image:
        _check_pixels(image, name)
        yield image


@contextmanager
def damage(name: str, what: str = "it does not decode completely") -> Iterator[None]:
    """Turn what Pillow raises for damaged files within the block into UnusablePicture, about the file `name`."""
    try:
        yield
    except DECODE_ERRORS as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise  # of the operating system, not of Pillow
        raise UnusablePicture("image_truncated", name, f"{what}: {plain(error)}") from error


@contextmanager
def room(image: Image.Image) -> Iterator[None]:
    """Wait until the memory that decoding takes is free: all pictures decoded at a time share a part of the machine's.

    A picture larger than that part is decoded alone. Not to be nested: the inner one could wait for the outer one.
    """
    with _room.taken(image.width * image.height):
        yield


def several(image: Image.Image) -> bool:
    """Whether the file holds more than one picture, such as an animation or the pages of a TIFF."""
    if image.format != "TIFF":
        # A JPEG's further pictures are previews and gain maps, which its format, MPO, distinguishes from its photo.
        return image.format != "MPO" and int(getattr(image, "n_frames", 1)) > 1
    # Counting the pages would read each of them, and a file can chain millions.
    try:
        image.seek(1)
    except DECODE_ERRORS:
        return False
    finally:
        image.seek(0)
    return True


def avif_tags(path: Path) -> tuple[int, int]:
    """The primaries and the transfer function that an AVIF names by H.273, which Pillow does not return.

    They are 2, unspecified, where FFmpeg cannot read the file.
    """
    import av  # a quarter of the start of a decoding process; only videos and AVIF need it

    options = {
        "protocol_whitelist": "file",
        "format_whitelist": "mov",
        "max_pixels": str(MAX_PHOTO_PIXELS),
    }
    try:
        with av.open(str(path), options=options, metadata_errors="replace", timeout=60.0) as container:
            codec = container.streams.video[0].codec_context
            return int(codec.color_primaries), int(codec.color_trc)
    except (av.FFmpegError, ValueError, LookupError, AttributeError):
        return UNSPECIFIED, UNSPECIFIED


def png_tags(path: Path) -> tuple[int, int]:
    """The primaries and the transfer function that the chunk cICP of a PNG names by H.273, which Pillow does not read.

    They are 2, unspecified, without such a chunk among the first MAX_CHUNKS.
    """
    with path.open("rb") as file:
        file.seek(8)
        for _ in range(MAX_CHUNKS):
            length, kind = int.from_bytes(file.read(4)), file.read(4)
            if kind == b"cICP" and length == 4:
                primaries, transfer, *_ = file.read(4).ljust(4, b"\0")
                return primaries, transfer
            if kind in (b"IDAT", b""):
                break
            file.seek(length + 4, os.SEEK_CUR)
    return UNSPECIFIED, UNSPECIFIED


def own_picture(path: Path) -> Image.Image:
    """Open a picture that this program wrote itself, such as a frame of the progress film."""
    return Image.open(path)


@contextmanager
def opened_video(path: Path) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
    """Open a video of one of CONTAINERS, and its first video stream.

    Raises UnusableVideo when it cannot be opened, has no video, or declares larger frames or more of them than the
    limits allow.
    """
    import av

    try:
        container = av.open(
            str(path),
            options={
                "protocol_whitelist": "file",
                "format_whitelist": CONTAINERS,
                "max_pixels": str(MAX_FRAME_PIXELS),
            },
            metadata_errors="replace",
            timeout=60.0,
        )
    except (av.FFmpegError, ValueError) as error:
        raise UnusableVideo(
            path.name, f"it does not decode as an MP4, MOV, MKV, WebM or AVI video ({plain(error)})"
        ) from error
    with container:
        if not container.streams.video:
            raise UnusableVideo(path.name, "it contains no video")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            raise UnusableVideo(path.name, "its video has a format that is not known")
        _check_frame(path.name, stream.width, stream.height)
        if stream.width * stream.height == 0:  # as FFmpeg leaves it for frames over max_pixels
            raise UnusableVideo(
                path.name,
                f"its frames have no size, or more than {MAX_FRAME_PIXELS / 1e6:.0f} million pixels",
            )
        check_frames(path.name, stream.frames)
        stream.thread_type = "AUTO"
        stream.codec_context.options = {"max_pixels": str(MAX_FRAME_PIXELS)}
        yield container, stream


def check_length(name: str, seconds: float) -> None:
    """Raise UnusableVideo for a video that is longer than MAX_VIDEO_SECONDS."""
    if not seconds <= MAX_VIDEO_SECONDS:
        raise UnusableVideo(
            name,
            f"it is {seconds:.0f} seconds long; at most {MAX_VIDEO_SECONDS:.0f} are read. Cut it into parts",
        )


def check_frames(name: str, count: int) -> None:
    """Raise UnusableVideo for a video that has more than MAX_VIDEO_FRAMES."""
    if count > MAX_VIDEO_FRAMES:
        raise UnusableVideo(name, f"it has {count} or more frames; at most {MAX_VIDEO_FRAMES} are read")


def frames(
    name: str, container: av.container.InputContainer, stream: av.VideoStream
) -> Iterator[av.VideoFrame]:
    """Decode the frames in order. Raises UnusableVideo at the first limit that is reached, and av.FFmpegError."""
    began = time.monotonic()
    for number, frame in enumerate(container.decode(stream)):
        _check_frame(name, frame.width, frame.height)
        check_frames(name, number + 1)
        if time.monotonic() - began > MAX_READING_SECONDS:
            raise UnusableVideo(
                name, f"reading it took longer than {MAX_READING_SECONDS:.0f} seconds, up to frame {number}"
            )
        yield frame


def _opened(path: Path, name: str) -> Image.Image:
    size = path.stat().st_size
    if size == 0:
        raise UnusablePicture("file_empty", name, "the file is empty")
    if size > MAX_PICTURE_BYTES:
        raise UnusablePicture(
            "image_too_large", name, f"the file has {size} bytes; at most {MAX_PICTURE_BYTES} are read"
        )
    try:
        return Image.open(path, formats=FORMATS)
    except UnidentifiedImageError as error:
        if _starts_as_avif(path):
            # Pillow reads all of such a file at once, and takes one that is cut off for one of another format.
            raise UnusablePicture(
                "image_truncated", name, "it does not decode completely: parts of it are damaged or missing"
            ) from error
        kind = recognised(path)
        said = UNKNOWN if kind is None else f"it is {kind}"
        raise UnusablePicture("not_an_image", name, said) from error


def _starts_as_avif(path: Path) -> bool:
    """Whether the first box of a file names a brand of AVIF."""
    with path.open("rb") as file:
        start = file.read(12)
    return start[4:8] == b"ftyp" and start[8:] in AVIF_BRANDS


def _check_pixels(image: Image.Image, name: str) -> None:
    if image.width * image.height > MAX_PHOTO_PIXELS:
        raise UnusablePicture(
            "image_too_large",
            name,
            f"it has {image.width} x {image.height} pixels; at most {MAX_PHOTO_PIXELS // 10**6} million are decoded",
        )


def _check_frame(name: str, width: int, height: int) -> None:
    if width * height > MAX_FRAME_PIXELS:
        raise UnusableVideo(
            name,
            f"its frames have {width} x {height} pixels; at most {MAX_FRAME_PIXELS / 1e6:.0f} million are decoded",
        )


class _Room:
    """Pixels that may be in decoding at a time, shared by all threads.

    lock: descriptor of a file that processes lock to decode a picture larger than their share, one at a time.
    """

    def __init__(self, pixels: int, lock: int | None = None) -> None:
        self._all = self._free = pixels
        self._changed = threading.Condition()
        self._lock = lock

    @contextmanager
    def taken(self, pixels: int) -> Iterator[None]:
        alone = self._lock if pixels > self._all else None
        pixels = min(pixels, self._all)
        with self._changed:
            self._changed.wait_for(lambda: self._free >= pixels)
            self._free -= pixels
        if alone is not None:
            fcntl.lockf(alone, fcntl.LOCK_EX)
        try:
            yield
        finally:
            if alone is not None:
                fcntl.lockf(alone, fcntl.LOCK_UN)
            with self._changed:
                self._free += pixels
                self._changed.notify_all()


def machine_bytes() -> int:
    """Return the bytes of memory of the machine or container."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min(total, memory.group_limit() or total)


def decoding_pixels(limit: int | None = None) -> int:
    """Return how many pixels may be in decoding at a time: a quarter of the memory of the machine or container, or of
    `limit` bytes if that is less.

    What is decoded is copied once or twice before it is reduced.
    """
    return min(machine_bytes(), limit or machine_bytes()) // 4 // _BYTES_PER_PIXEL


_room = _Room(decoding_pixels())


def share_room(pixels: int, lock: int) -> None:
    """Decode so many pixels at a time in this process; larger pictures take turns with other processes by `lock`."""
    global _room
    _room = _Room(pixels, lock)
