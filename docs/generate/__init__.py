"""The pages that are made from the program each time the documentation is built; some of them are committed.

One module per page. Each has a function `page()` that returns the page as Markdown.
"""

from pathlib import Path

from docs.generate import (
    command_line,
    environment,
    errors,
    formats,
    hostile,
    inputs,
    metrics,
    python_errors,
    rest,
    rooms,
    settings,
)

from splatmill.files import atomic_write

PAGES = {
    "command-line.md": command_line.page,
    "environment.md": environment.page,
    "errors.md": errors.page,
    "formats.md": formats.page,
    "hostile.md": hostile.page,
    "metrics.md": metrics.page,
    "python-errors.md": python_errors.page,
    "rest.md": rest.page,
    "settings.md": settings.page,
}

COMMITTED = {
    "docs/inputs.md": inputs.page,
    "ARCHITECTURE.md": rooms.architecture,
    "MAP.md": rooms.modules,
}
"""Pages that are committed because people read them in the repository. Tests compare them."""


def write_pages(folder: Path, *, ask: bool = True) -> None:
    """Write every generated page into `folder`, and the committed ones to their places.

    A page whose text has not changed keeps its time stamp.

    ask: give the program the inputs whose answers pages show. Otherwise, hostile inputs have the expected answers, and
        committed pages are left as they are.
    """
    folder.mkdir(exist_ok=True)
    places = {folder / name: page for name, page in PAGES.items()}
    if ask:
        places |= {rooms.ROOT / name: page for name, page in COMMITTED.items()}
    else:
        places[folder / "hostile.md"] = hostile.expected_page
    for path, page in places.items():
        text = page()
        if not path.is_file() or path.read_text() != text:
            atomic_write(path, text)
