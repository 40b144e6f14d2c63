"""Which files of other programs have cameras, and what they say: in a process of its own, by `decoders.call_once`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from splatmill.data_sets import fits
from splatmill_worker.readers.programs import (
    bundler,
    gaussian_splatting,
    metashape,
    opensfm,
    realityscan,
    record3d,
    visualsfm,
)
from splatmill_worker.readers.programs.shots import Shots

HEAD = 64 * 2**10
"""Bytes at the beginning of a file by which it is recognised."""


@dataclass(frozen=True)
class Kind:
    """A kind of files with cameras.

    program: that writes them, in a sentence.
    names: patterns of their names, in lower case.
    marks: texts of which all are in the beginning of a file, in lower case.
    read: reads the files of one data set.
    many: whether each photo has a file of its own.
    """

    program: str
    names: tuple[str, ...]
    marks: tuple[str, ...]
    read: Callable[[list[Path]], Shots]
    many: bool = False


KINDS = (
    Kind("Metashape", ("*.xml",), ("<chunk", "<sensors"), metashape.read),
    Kind("RealityScan", ("*.csv",), ("heading", "pitch", "roll"), realityscan.read_csv),
    Kind(
        "RealityScan (XMP)",
        ("*.xmp",),
        ("capturingreality.com/ns/xcr", "rotation"),
        realityscan.read_xmp,
        many=True,
    ),
    Kind("OpenSfM", ("reconstruction.json",), ('"cameras"',), opensfm.read),
    Kind("Bundler", ("*.out",), ("# bundle file",), bundler.read),
    Kind("VisualSFM", ("*.nvm",), ("nvm_v3",), visualsfm.read),
    Kind(
        "3D Gaussian Splatting",
        ("cameras.json",),
        ('"img_name"', '"position"', '"rotation"'),
        gaussian_splatting.read,
    ),
    Kind("Record3D", ("metadata.json", "metadata"), ('"poses"', '"k"'), record3d.read),
)
"""In order of preference, where a data set has cameras of several."""


def kind_of(path: Path) -> Kind | None:
    """The kind of cameras that a file has; None for one without any. Raises OSError."""
    with path.open("rb") as file:
        head = file.read(HEAD)
    # Text of UTF-16 has a zero beside each letter of ASCII.
    text = head.replace(b"\0", b"").decode("utf-8", "replace").lower()
    kinds = (kind for kind in KINDS if fits(path.name, kind.names))
    return next((kind for kind in kinds if all(mark in text for mark in kind.marks)), None)


def read(path: Path, others: tuple[str, ...]) -> dict[str, Any]:
    """The Shots of a file and of others that belong to it, as a dictionary. Raises ValueError, and OSError."""
    kind = kind_of(path)
    if kind is None:
        raise ValueError("it has no cameras of a program that is known")
    shots = kind.read([path, *map(Path, others)])
    return {
        "shots": [asdict(shot) for shot in shots.shots],
        "left_out": shots.left_out,
        "faulty": shots.faulty,
        "notes": shots.notes,
        "warnings": shots.warnings,
        "points": shots.points,
        "colors": shots.colors,
    }
