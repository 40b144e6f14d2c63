"""Which files are results that Splatmill wrote, by their names, so that none is read as a photo or as cameras."""

from collections import Counter
from collections.abc import Iterable

OUTPUT_MARKS = ("model.ply", "report.json", "cameras.json")
"""Names of files of which a folder of results holds two at least. The first two are written before any picture."""

OUTPUT_MEDIA = (
    "preview.jpg",
    "poster.jpg",
    "report.png",
    "novel_view.png",
    "orbit.mp4",
    "progress.mp4",
    "cameras.zip",
    "cameras.json",
)
"""Names of files that are written to a folder of results, and that elsewhere hold photos or cameras."""


def own_outputs(names: Iterable[str]) -> set[str]:
    """Return those of the files `names` that are OUTPUT_MEDIA in folders of results."""
    placed = [(name, *name.rpartition("/")[::2]) for name in names]
    marks = Counter(folder for _, folder, last in placed if last in OUTPUT_MARKS)
    return {name for name, folder, last in placed if last in OUTPUT_MEDIA and marks[folder] >= 2}
