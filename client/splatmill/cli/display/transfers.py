"""A progress bar for the bytes of downloads, on a terminal."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

OnFileBytes = Callable[[str, int, int | None], None]
"""Called with the name of a file, the number of its bytes received so far, and its size where it is known."""


@contextmanager
def make_transfer_display() -> Iterator[OnFileBytes]:
    """Yield a function that shows how far a download is; where standard output is no terminal, it shows nothing."""
    if not sys.stdout.isatty():
        yield lambda name, done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TaskID, TextColumn, TransferSpeedColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=24),
        DownloadColumn(),
        TransferSpeedColumn(),
    )
    with Progress(*columns, console=Console(highlight=False), transient=True) as bar:
        tasks: dict[str, TaskID] = {}

        def show(name: str, done: int, total: int | None) -> None:
            if name not in tasks:
                for task in tasks.values():
                    bar.update(task, visible=False)
                tasks[name] = bar.add_task(name, total=total, completed=done)
            bar.update(tasks[name], completed=done, total=total)

        yield show
