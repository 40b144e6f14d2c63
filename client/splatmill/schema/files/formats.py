"""The file formats of models: which are read, which are written, and what each of them loses."""

from dataclasses import dataclass

from splatmill.schema.files.photos import ARCHIVE_SUFFIXES


@dataclass(frozen=True)
class ModelFormat:
    """A file format of models.

    suffix: in lower case, with its dot; a name without one where files are called just so.
    name: what the format is called.
    media_type: with which it is served.
    readable: whether a model can be read from it.
    writable: whether a model can be written to it.
    loses: what a model loses in it, as a sentence.
    readers: programs that read it, of others.
    folder: whether a model in it is a folder of many files, of which this one names the others.
    """

    suffix: str
    name: str
    media_type: str
    readable: bool
    writable: bool
    loses: str
    readers: tuple[str, ...] = ()
    folder: bool = False

    @property
    def key(self) -> str:
        """The suffix without its dot, as it is written in addresses: "sog"."""
        return self.suffix.removeprefix(".")


MODEL_FORMATS: dict[str, ModelFormat] = {
    form.suffix: form
    for form in (
        ModelFormat(
            ".ply",
            "3D Gaussian .ply",
            "application/octet-stream",
            readable=True,
            writable=True,
            loses="Nothing, as every parameter is stored as float32.",
            readers=("SuperSplat", "PlayCanvas", "Spark", "Babylon.js"),
        ),
        ModelFormat(
            ".compressed.ply",
            "compressed .ply (SuperSplat, PlayCanvas)",
            "application/octet-stream",
            readable=True,
            writable=True,
            loses="Positions and scales keep 10 to 11 bits within a chunk of 256 Gaussians, colours and opacities 8; "
            "view-dependent colour is limited to 4 and keeps steps of 1/32.",
            readers=("SuperSplat", "PlayCanvas", "Spark"),
        ),
        ModelFormat(
            ".spz",
            ".spz of Niantic and Scaniverse",
            "application/octet-stream",
            readable=True,
            writable=True,
            loses="Scales keep steps of 6 % and lie between 0.00005 and 380 units, opacities and colours keep 8 bits, "
            "view-dependent colour is limited to 1 and keeps 6 bits. The offset of far scenes is lost.",
            readers=("Scaniverse", "Spark", "Babylon.js", "splat-transform"),
        ),
        ModelFormat(
            ".splat",
            ".splat of antimatter15",
            "application/octet-stream",
            readable=True,
            writable=False,
            loses="All view-dependent colour; colours, opacities and quaternions keep 8 bits.",
        ),
        ModelFormat(
            ".ksplat",
            ".ksplat of GaussianSplats3D",
            "application/octet-stream",
            readable=True,
            writable=False,
            loses="View-dependent colour of degree 3; at levels 1 and 2 positions keep 16 bits in a bucket, and the "
            "rest 8 to 16.",
        ),
        ModelFormat(
            ".sog",
            "SOG, version 2 (PlayCanvas)",
            "application/octet-stream",
            readable=True,
            writable=True,
            loses="Positions keep 16 bits of their logarithm; scales and colours are of 256 values, chosen for the "
            "scene; rotations and opacities keep 8 bits; similar Gaussians get the same view-dependent colour.",
            readers=("SuperSplat", "PlayCanvas", "Spark", "Babylon.js"),
        ),
        ModelFormat(
            "meta.json",
            "SOG, version 2, unpacked: the meta.json beside its images",
            "application/json",
            readable=True,
            writable=False,
            loses="What .sog loses.",
        ),
        ModelFormat(
            "lod-meta.json",
            "Streamed SOG, version 1: levels of detail in folders beside the lod-meta.json",
            "application/json",
            readable=True,
            writable=True,
            loses="What .sog loses, in the finest level.",
            readers=("SuperSplat", "PlayCanvas", "Babylon.js", "splat-transform"),
            folder=True,
        ),
        ModelFormat(
            ".lod.zip",
            "Streamed SOG, version 1, in a .zip: levels of detail that the page loads in parts",
            "application/zip",
            readable=True,
            writable=True,
            loses="What .sog loses, in the finest level.",
            readers=("SuperSplat, PlayCanvas, Babylon.js and splat-transform once it is unpacked",),
        ),
        ModelFormat(
            ".glb",
            "binary glTF with KHR_gaussian_splatting",
            "model/gltf-binary",
            readable=True,
            writable=True,
            loses="Nothing, as every parameter is stored as float32.",
            readers=("PlayCanvas", "Babylon.js"),
        ),
        ModelFormat(
            "tileset.json",
            "3D Tiles 1.1: levels of detail at their place on the earth, in a folder beside the tileset.json",
            "application/json",
            readable=False,
            writable=True,
            loses="What .spz loses, and the far surroundings of the scene.",
            readers=("CesiumJS",),
            folder=True,
        ),
    )
}
"""All formats by their suffix."""


def is_model_file(name: str) -> bool:
    """Whether a name is that of a file that a training may start from: of a model that can be read, in one file.

    An archive is none: of those, what is uploaded is unpacked.
    """
    form = format_of(name)
    return (
        form is not None
        and form.readable
        and form.suffix[0] == "."
        and not form.suffix.endswith(ARCHIVE_SUFFIXES)
    )


POINT_FORMATS: dict[str, str] = {
    ".las": "LAS of laser scanners",
    ".laz": "LAS, compressed",
    ".e57": "E57 of laser scanners",
    ".pcd": "PCD of the Point Cloud Library",
    ".xyz": "text with a point a line: x, y, z, and red, green, blue where it has them",
    ".pts": "the same, with an intensity before the colours and the number of points in the first line",
}
"""Formats of points alone by their suffix, besides .ply, which holds points or a model."""


def is_point_file(name: str) -> bool:
    """Whether a name is that of a file of points alone; one of a .ply does not say so."""
    return name.lower().endswith(tuple(POINT_FORMATS))


def is_start_file(name: str) -> bool:
    """Whether a name is that of a file that a training may start from: of a model, or of points."""
    return is_model_file(name) or is_point_file(name)


def start_suffixes() -> str:
    """The suffixes of the files that a training may start from, for a sentence."""
    suffixes = [suffix for suffix in (*MODEL_FORMATS, *POINT_FORMATS) if is_start_file(suffix)]
    return f"{', '.join(suffixes[:-1])} or {suffixes[-1]}"


def format_of(name: str) -> ModelFormat | None:
    """The format of a file by its name: that of the longest suffix that fits, or None.

    A format without a dot before it is that of files with just this name.
    """
    lower = name.lower()
    matches = [
        form
        for suffix, form in MODEL_FORMATS.items()
        if (lower.endswith(suffix) if suffix.startswith(".") else lower == suffix)
    ]
    return max(matches, key=lambda form: len(form.suffix), default=None)


DOWNLOADS: dict[str, ModelFormat] = {
    form.key: form for form in MODEL_FORMATS.values() if form.writable and not form.folder
}
"""The formats in which a model can be downloaded, by their keys: those of one file."""
