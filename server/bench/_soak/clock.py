"""The injected clock of a soak: a library that the service's processes preload, and the seconds that it is off by."""

import mmap
import os
import shutil
import struct
import subprocess
from pathlib import Path


class Clock:
    """A clock that this process can set. `missing` says why there is none.

    environment: variables of the processes that are to follow it.
    """

    def __init__(self, folder: Path) -> None:
        self.offset = 0.0
        self.environment: dict[str, str] = {}
        self.missing: str | None = None
        library, self._file = folder / "clock.so", folder / "clock"
        self._file.write_bytes(struct.pack("d", 0.0))
        compiler = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc")
        if compiler is None:
            self.missing = "no C compiler to build the clock with"
            return
        source = Path(__file__).with_name("clock.c")
        built = subprocess.run(
            [compiler, "-shared", "-fPIC", "-O1", "-o", library, source], capture_output=True, text=True
        )
        if built.returncode:
            self.missing = f"the clock cannot be built: {built.stderr.strip()[:200]}"
            return
        self.environment = {"LD_PRELOAD": str(library), "SOAK_CLOCK": str(self._file)}

    def jump(self, seconds: float) -> None:
        """Set the clock forward by whole seconds, or back."""
        self.offset += seconds
        with self._file.open("r+b") as file, mmap.mmap(file.fileno(), 8) as page:
            page[:8] = struct.pack("d", self.offset)
