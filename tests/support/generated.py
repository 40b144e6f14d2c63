"""Every committed file that follows from others. `make generated` writes those that differ; tests compare them."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from docs.generate import COMMITTED

from splatmill.files import atomic_write
from tests.support import arguments, synchronous
from tests.support.paths import ROOT

FILES: dict[Path, Callable[[], str]] = {
    arguments.PATH: arguments.text,
    **{synchronous.PACKAGE / name: partial(synchronous.text, name) for name in synchronous.SOURCES},
    **{ROOT / name: page for name, page in COMMITTED.items()},
}
"""Their paths, and what makes their text."""


def main() -> None:
    """Write the files whose text differs, and name them."""
    for path, text in FILES.items():
        if not path.is_file() or path.read_text() != text():
            atomic_write(path, text())
            print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
