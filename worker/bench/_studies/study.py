"""The runner of all studies: measures cases, keeps their rows, and makes page and figures of them.

Common to all: results/NAME.jsonl has the last row of each measurement, which `key` names; NAME.md has the prose, and
between comments what is made from rows (`_page`); figures/ has the figures.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import _plot
from _page import filled
from _rows import HERE, Row, append, footer, lines, origin, replace
from matplotlib.figure import Figure

Case = Callable[[argparse.Namespace], Iterable[Row | str]]
"""Rows of a case, for the options of the command; a sentence in place of a row says what was left out and why.
`options.known` are the rows of earlier measurements."""


@dataclass(frozen=True)
class Study:
    """What is measured, and what is made of it.

    name: of the command, of the files of rows and page.
    about: text of --help.
    cases: what can be measured alone, by name.
    key: fields that no two measurements share all of.
    blocks: text of each block of the page, by its name.
    figures: by the stem of their files; a figure's label stands behind its footer.
    home: the folder of page, rows and figures.
    parts: of the repository that are measured, beside the worker.
    order: sorts the rows; as they were measured first where it is left out.
    options: of the command, beside those of every study: by name, arguments of `add_argument`.
    """

    name: str
    about: str | None
    cases: Mapping[str, Case]
    key: tuple[str, ...]
    blocks: Mapping[str, Callable[[list[Row]], str]]
    figures: Mapping[str, Callable[[list[Row]], Figure]]
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    home: Path = HERE
    parts: tuple[str, ...] = ()
    order: Callable[[Row], Any] = lambda _: 0

    def rows(self, folder: Path | None = None) -> list[Row]:
        """The last row of each measurement."""
        last = {tuple(row.get(name) for name in self.key): row for row in lines(self.place(folder))}
        return sorted(last.values(), key=self.order)

    def place(self, folder: Path | None = None) -> Path:
        """The file of the rows."""
        return (folder or self.home) / "results" / f"{self.name}.jsonl"

    def page(self, rows: list[Row]) -> str:
        """The page, with what these rows say in it."""
        text = (self.home / f"{self.name}.md").read_text()
        return filled(text, {name: block(rows) for name, block in self.blocks.items()})

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            prog=f"splatmill bench {self.name}",
            description=self.about,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        add = parser.add_argument
        if len(self.cases) > 1:
            add("--only", nargs="+", choices=self.cases, metavar="CASE", help=f"of {', '.join(self.cases)}")
        add("--dry", action="store_true", help="print rows, and write nothing")
        add("--plot-only", action="store_true", help="page and figures from the rows that there are")
        add("--out", type=Path, default=self.home, help="folder of results/, figures/ and the page")
        for name, arguments in self.options.items():
            add(f"--{name}", **arguments)
        return parser

    def measure(self, options: argparse.Namespace) -> bool:
        """Measure the cases; each row is kept as soon as it is there. Returns whether nothing was left out."""
        whole = True
        for name in (options.only if len(self.cases) > 1 else None) or self.cases:
            options.known = self.rows(options.out)
            for row in self.cases[name](options):
                if isinstance(row, str):
                    whole = False
                    print(row, file=sys.stderr)
                    continue
                print(
                    json.dumps({k: v for k, v in row.items() if not isinstance(v, dict | list)}), flush=True
                )
                if not options.dry:
                    append(self.place(options.out), row | origin(*self.parts))
        return whole

    def main(self, argv: list[str]) -> int:
        """Run the command; 1 where something was left out, or where there are no rows."""
        options = self.parser().parse_args(argv)
        whole = options.plot_only or self.measure(options)
        if options.dry:
            return 0 if whole else 1
        rows = self.rows(options.out)
        if not rows:
            print(f"There are no rows in {self.place(options.out)}.", file=sys.stderr)
            return 1
        if not options.plot_only:
            replace(self.place(options.out), rows)
        for stem, draw in self.figures.items():
            figure = draw(rows)
            note = f"{footer(rows)}{figure.get_label()}"
            _plot.save(figure, options.out / "figures" / f"{stem}.png", note)
        (options.out / f"{self.name}.md").write_text(self.page(rows))
        return 0 if whole else 1


def generated(name: str, rows: list[Row]) -> str:
    """The last line of a page that names the command."""
    return f"Generated by `splatmill bench {name}`. {footer(rows)}"
