"""Decompression of files of strangers: never more than is expected."""

from __future__ import annotations

import zlib


class Gunzip:
    """The contents of gzip data, piece by piece."""

    def __init__(self, data: bytes) -> None:
        self._stream = zlib.decompressobj(wbits=31)
        self._rest = data

    def take(self, size: int) -> bytes:
        """The next `size` bytes. Raises ValueError if there are fewer, or if the data are damaged."""
        if not size:
            return b""  # zero means without limit to zlib
        try:
            piece = self._stream.decompress(self._rest, size)
        except zlib.error as error:
            raise ValueError("its gzip data are damaged") from error
        self._rest = self._stream.unconsumed_tail
        if len(piece) < size:
            raise ValueError(f"its gzip data end after {len(piece)} of {size} bytes")
        return piece

    def rest(self) -> bytes:
        """What follows, up to 64 KiB. Raises ValueError if the data are damaged."""
        try:
            return self._stream.decompress(self._rest, 2**16)
        except zlib.error as error:
            raise ValueError("its gzip data are damaged") from error


def unzstd(data: bytes, size: int) -> bytes:
    """The `size` bytes in a zstd frame. Raises ValueError if there are more or fewer, or if the data are damaged."""
    import zstandard

    try:
        with zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(data) as stream:
            piece = stream.read(size)
            more = stream.read(1)
    except zstandard.ZstdError as error:
        raise ValueError("its zstd data are damaged") from error
    if len(piece) < size or more:
        raise ValueError(f"a stream of zstd data has {'more' if more else 'fewer'} than {size} bytes")
    return piece
