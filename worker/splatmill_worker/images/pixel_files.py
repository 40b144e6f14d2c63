"""Files without names that hold the pixels of photos, mapped into memory: the system writes them out and reads them
again as it needs the memory.
"""

from __future__ import annotations

import mmap
import tempfile
import threading
from bisect import bisect_right
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

BLOCK_BYTES = 64 * 2**20
"""Bytes of a file. Each is mapped as a whole, since the system maps some 65,000 files at most into a process."""


class PixelFiles:
    """Room for the pixels of many photos in files of `folder`, which exist as long as this or what lies in them does.

    May be used by several threads at once.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._blocks: list[tuple[int, mmap.mmap]] = []  # the address of each, ascending
        self._last: npt.NDArray[np.uint8] = np.empty(0, np.uint8)
        self._used = 0

    def placed(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """A copy of `values`, of any type of one byte, in a file. Raises OSError where the disk is full."""
        place = self._room(values.size)[: values.size].view(values.dtype).reshape(values.shape)
        place[...] = values
        return place

    def read_ahead(self, values: Tensor) -> None:
        """Have the system read what lies at `values` in the background, where it is not in memory."""
        address = values.data_ptr()
        with self._lock:
            index = bisect_right(self._blocks, address, key=lambda block: block[0]) - 1
            if index < 0:
                return
            start, block = self._blocks[index]
        begin = (address - start) // mmap.PAGESIZE * mmap.PAGESIZE
        end = min(address - start + values.nbytes, len(block))
        if begin < end and hasattr(block, "madvise"):
            block.madvise(mmap.MADV_WILLNEED, begin, end - begin)

    def _room(self, size: int) -> npt.NDArray[np.uint8]:
        """The next `size` bytes, from the beginning of a page."""
        with self._lock:
            if self._used + size > len(self._last):
                self._add_block(max(size, BLOCK_BYTES))
            begin = self._used
            self._used = -(-(begin + size) // mmap.PAGESIZE) * mmap.PAGESIZE
            return self._last[begin : begin + size]

    def _add_block(self, size: int) -> None:
        with tempfile.TemporaryFile(dir=self._folder) as file:
            # Written, not left sparse: a full disk is then an error here, and not the end of the process later.
            zeros = bytes(min(size, 2**20))
            for begin in range(0, size, len(zeros)):
                file.write(zeros[: size - begin])
            file.flush()
            block = mmap.mmap(file.fileno(), size)
        self._last, self._used = np.frombuffer(block, np.uint8), 0
        self._blocks.append((self._last.ctypes.data, block))
        self._blocks.sort(key=lambda each: each[0])
