"""Every code block of the README and of the documentation runs as it is written.

Shell and Python blocks run in order, page by page, in a folder with photos of the still life, against a real service
where they talk to one. What they print must have the shape of the `output` block that follows.
`tests.support.documentation.reader` lists what is made smaller before a block runs. Blocks that cannot run here carry a
mark with the reason, and the test prints and counts them.

Does not prove the figures in the output, nor that prose about a block is true.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.support.documentation.markdown import GUIDES, Block, blocks
from tests.support.documentation.reader import Beginning, Reader, Services
from tests.support.documentation.shapes import mismatch
from tests.support.paths import ROOT

PAGES = [ROOT / "README.md", *GUIDES]
RUN = {"bash", "python"}
CHECKED = {"output", "json", "text"}
MARKS = {None, "not run", "exits", "serves"}
NOT_RUN = 20
"""How many blocks are not run; a new one needs a reason that a reviewer sees here."""


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.fixture(scope="module")
def beginning(tmp_path_factory: pytest.TempPathFactory) -> Beginning:
    return Beginning.of(tmp_path_factory.mktemp("beginning") / "reader")


@pytest.fixture(scope="module")
def services() -> Iterator[Services]:
    started = Services()
    yield started
    started.stop()


@pytest.fixture(scope="module")
def readings(
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
    beginning: Beginning,
    services: Services,
) -> Iterator[dict[Path, Future[None]]]:
    """The reading of each page that is tested, two at a time: half of the time goes into the start of programs."""
    pages = [page for page in PAGES if f"test_the_blocks_run[{name_of(page)}]" in _selected(request)]
    with ThreadPoolExecutor(2) as pool:
        yield {
            page: pool.submit(
                _read, page, Reader(tmp_path_factory.mktemp(page.stem) / "reader", beginning, services)
            )
            for page in pages
        }


def _selected(request: pytest.FixtureRequest) -> set[str]:
    return {item.name for item in request.session.items}


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_the_blocks_run(page: Path, readings: dict[Path, Future[None]]) -> None:
    readings[page].result()


def _read(page: Path, reader: Reader) -> None:
    printed = ""
    try:
        for block in blocks(page):
            if block.mark == "not run":
                continue
            if block.language == "output":
                why = mismatch(block.text, printed)
                assert why is None, f"{block.place}: {why}"
            elif block.language == "json":
                json.loads(block.text)
            elif block.language in RUN:
                printed = _run(reader, block)
    finally:
        reader.close()


def _run(reader: Reader, block: Block) -> str:
    if block.mark == "serves":
        ran = reader.serve(block.text)
    else:
        ran = reader.shell(block.text) if block.language == "bash" else reader.python(block.text)
    expected = int(block.value) if block.mark == "exits" else 0
    assert ran.status == expected, f"{block.place} ended with {ran.status}:\n{ran.printed}"
    return ran.printed


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_block_has_a_language_and_a_known_mark(page: Path) -> None:
    for block in blocks(page):
        assert block.language in RUN | CHECKED or block.language.startswith("{"), block.place
        assert block.mark in MARKS, f"{block.place}: {block.mark}"


def test_blocks_that_are_not_run_say_why() -> None:
    skipped = [block for page in PAGES for block in blocks(page) if block.mark == "not run"]
    for block in skipped:
        print(f"{block.place}: {block.value}")
    assert all(len(block.value) > 10 for block in skipped)
    assert len(skipped) == NOT_RUN, [block.place for block in skipped]
