"""Proves that points of every format of scanners are read where they are, in their colours, and thinned evenly.

Files are written by the libraries of their formats. Does not prove anything about files of real scanners.
"""

from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pye57
import pytest
from plyfile import PlyData, PlyElement
from pypcd4 import Encoding, PointCloud

from splatmill_worker.readers import scan

UTM = np.array([500_000.0, 5_400_000.0, 300.0])
"""An offset at which float32 keeps half a metre."""

COUNT = 500

Write = Callable[[Path, np.ndarray, np.ndarray], None]


def cloud() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    return UTM + random.uniform(-5, 5, (COUNT, 3)), random.integers(256, size=(COUNT, 3)).astype(np.uint8)


def write_las(path: Path, points: np.ndarray, colors: np.ndarray, scale: int = 257) -> None:
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.offsets, header.scales = UTM, [0.0001] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.red, las.green, las.blue = (colors.astype(np.uint16) * scale).T
    las.write(path)


def write_dark_las(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """With colours of 8 bits in the 16 of the format, as several programs write them."""
    write_las(path, points, colors, scale=1)


def write_e57(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Two scans, of which the second was turned by a quarter turn about z and moved."""
    file = pye57.E57(str(path), mode="w")
    half = COUNT // 2
    for part, turned in ((slice(half), False), (slice(half, None), True)):
        local = points[part] - UTM
        if turned:
            local = np.stack([local[:, 1], -local[:, 0], local[:, 2]], axis=1)
        data = {f"cartesian{axis}": local[:, index] for index, axis in enumerate("XYZ")}
        data |= {f"color{name}": colors[part, index] for index, name in enumerate(("Red", "Green", "Blue"))}
        rotation = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)] if turned else [1.0, 0, 0, 0])
        file.write_scan_raw(data, rotation=rotation, translation=UTM)
    file.close()


def write_pcd(encoding: Encoding) -> Write:
    def write(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
        rgb = PointCloud.encode_rgb(colors).ravel()
        # As the Point Cloud Library does: text would lose digits of a float.
        as_text = encoding is Encoding.ASCII
        values = [*points.T, rgb.view(np.uint32) if as_text else rgb]
        types = (np.float64, np.float64, np.float64, np.uint32 if as_text else np.float32)
        fields = ("x", "y", "z", "rgb")
        PointCloud.from_points(values, fields, types).save(path, encoding=encoding)

    return write


def write_ply(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    types = [*((axis, "f8") for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    rows = np.array([(*p, *c) for p, c in zip(points, colors, strict=True)], types)
    PlyData([PlyElement.describe(rows, "vertex")]).write(path)


def text(separator: str, head: str = "", middle: str = "") -> Write:
    def write(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
        rows = [
            separator.join([*(f"{x:.4f}" for x in point), *([middle] if middle else []), *map(str, color)])
            for point, color in zip(points, colors, strict=True)
        ]
        path.write_text(head + "\n".join(rows) + "\n", "utf-8")

    return write


WRITERS: dict[str, tuple[str, Write]] = {
    "LAS": ("a.las", write_las),
    "LAS with colours of 8 bits": ("a.LAS", write_dark_las),
    "LAZ": ("a.laz", write_las),
    "E57 of two scans": ("a.e57", write_e57),
    "PCD, text": ("a.pcd", write_pcd(Encoding.ASCII)),
    "PCD, binary": ("a.pcd", write_pcd(Encoding.BINARY)),
    "PCD, compressed": ("a.pcd", write_pcd(Encoding.BINARY_COMPRESSED)),
    "PLY": ("a.ply", write_ply),
    "XYZ": ("a.xyz", text(" ")),
    "XYZ with commas and a heading": ("a.xyz", text(", ", "\ufeffx, y, z, r, g, b\n")),
    "PTS": ("a.pts", text(" ", f"{COUNT}\n", "-1200")),
}


@pytest.mark.parametrize("name", WRITERS)
def test_points_and_colours_are_read_exactly(name: str, tmp_path: Path) -> None:
    file, write = WRITERS[name]
    points, colors = cloud()
    write(tmp_path / file, points, colors)
    read, shown, count = scan.read(tmp_path / file)
    assert count == COUNT
    np.testing.assert_allclose(read, points, atol=1e-4)
    np.testing.assert_array_equal(shown, colors)


@pytest.mark.parametrize("name", WRITERS)
def test_of_many_points_every_third_is_kept(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, write = WRITERS[name]
    points, colors = cloud()
    write(tmp_path / file, points, colors)
    monkeypatch.setattr(scan, "MOST", 200)
    monkeypatch.setattr(scan, "CHUNK", 70)
    read, shown, count = scan.read(tmp_path / file)
    assert count in (COUNT, COUNT + 1)  # of text, a heading may count as a point
    assert 166 <= len(read) == len(shown) <= 170
    distances = np.abs(read[:, None] - points[None]).max(axis=2)
    np.testing.assert_array_equal(shown, colors[distances.argmin(axis=1)])
    assert distances.min(axis=1).max() < 1e-4
    assert {int(step) for step in np.diff(distances.argmin(axis=1))} <= {1, 3}  # 1 between the two scans


def test_columns_that_are_no_colours(tmp_path: Path) -> None:
    (tmp_path / "normals.xyz").write_text("1 2 3 0 0 -1\n4 5 6 0.6 0.8 0\n")
    (tmp_path / "bare.xyz").write_text("# metres\n1 2 3\nnan 2 3\n4 5 6\n")
    for name in ("normals.xyz", "bare.xyz"):
        points, colors, _ = scan.read(tmp_path / name)
        assert points.tolist() == [[1, 2, 3], [4, 5, 6]]
        assert (colors == 128).all()


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5])
def test_a_file_that_ends_early_is_refused_or_read_as_far_as_it_goes(
    name: str, share: float, tmp_path: Path
) -> None:
    file, write = WRITERS[name]
    points, colors = cloud()
    write(tmp_path / file, points, colors)
    data = (tmp_path / file).read_bytes()
    (tmp_path / file).write_bytes(data[: int(share * len(data))])
    if share > 0.0 and file.endswith((".xyz", ".pts")):
        read, _, count = scan.read(tmp_path / file)
        assert len(read) <= count <= COUNT
        return
    with pytest.raises(ValueError, match=r"\w"):
        scan.read(tmp_path / file)
