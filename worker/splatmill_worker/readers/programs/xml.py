"""Reads XML of strangers: without a document type, whose entities could expand without end."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

from splatmill_worker.readers.programs.shots import NoCameras, text_of

_DECLARATION = re.compile(r"^\s*<\?xml[^>]*\?>")
_ENTITIES = re.compile(r"<!(DOCTYPE|ENTITY)", re.IGNORECASE)


def root_of(path: Path) -> ElementTree.Element:
    """The outermost element. Raises NoCameras for text that does not begin as XML, and ValueError for damaged XML."""
    # The text is decoded here, so that an encoding in its first line no longer holds.
    text = _DECLARATION.sub("", text_of(path))
    if not text.lstrip().startswith("<"):
        raise NoCameras("it is no XML")
    if _ENTITIES.search(text):
        raise ValueError("it has a document type or entities, which no program writes into a file of cameras")
    try:
        return ElementTree.fromstring(text.strip())
    except ElementTree.ParseError as error:
        raise ValueError(f"it is damaged or cut off: {error}") from error
