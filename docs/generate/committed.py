"""The committed files that are made from the source code. `make generated` writes those that differ.

Tests compare them. Tables of measurements are written by the commands that measure.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from runpy import run_path

from docs.generate import COMMITTED

from splatmill.files import atomic_write
from tests.support import arguments, synchronous
from tests.support.paths import ROOT

MONITORING = ROOT / "server" / "monitoring"

FILES: dict[Path, Callable[[], str]] = {
    arguments.PATH: arguments.text,
    **{synchronous.PACKAGE / name: partial(synchronous.text, name) for name in synchronous.SOURCES},
    **{ROOT / name: page for name, page in COMMITTED.items()},
    MONITORING / "dashboard.json": lambda: run_path(str(MONITORING / "dashboard.py"))["text"](),
}
"""Their paths, and what makes their text."""


def main() -> None:
    """Write the files whose text differs, and name them."""
    for path, make in FILES.items():
        text = make()
        if not path.is_file() or path.read_text() != text:
            atomic_write(path, text)
            print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
