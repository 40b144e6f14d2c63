"""Small inputs as people have them, with the kind of answer that each gets. docs/generate/inputs.py prints the answers.

A row added here is a row of the page, and a case of tests/inputs/test_examples.py.
"""

from __future__ import annotations

import json
import os
import struct
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from tests.support.files import unmarked_zip
from tests.support.files.program_files import PROGRAMS, SIZE, record3d
from tests.support.inputs.example import Example, Kind
from tests.support.panoramas import gpano, striped
from tests.support.posed_sets import COUNT, NAMES, frames, model, photos, transforms, viewmat, zip_of
from tests.support.scenes import depth_sets

Make = Callable[[Path], object]


def _noise(path: Path, seed: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(seed).integers(0, 255, (48, 64, 3), np.uint8)).save(path)


def plain(folder: Path, suffix: str = ".jpg", count: int = 4) -> None:
    """Photos without cameras."""
    for seed in range(count):
        _noise(folder / f"{seed}.jpg", seed)
        (folder / f"{seed}.jpg").rename(folder / f"{seed}{suffix}")


def with_file(name: str, data: bytes = b"x") -> Make:
    def make(folder: Path) -> None:
        plain(folder)
        for one in name.split():
            (folder / one).parent.mkdir(parents=True, exist_ok=True)
            (folder / one).write_bytes(data)

    return make


def alone(name: str) -> Make:
    return lambda folder: (folder / name).write_bytes(b"x")


def spaced(folder: Path) -> None:
    plain(folder)
    (folder / "1.jpg").rename(folder / "x:1.jpg")
    (folder / "2.jpg").rename(folder / " lead.jpg")


def linked(folder: Path) -> None:
    plain(folder)
    (folder / "5.jpg").symlink_to("/nowhere/5.jpg")
    os.mkfifo(folder / "6.jpg")
    (folder / "again").symlink_to(folder)


def cut_off(folder: Path) -> None:
    plain(folder)
    data = (folder / "2.jpg").read_bytes()
    (folder / "2.jpg").write_bytes(data[: len(data) // 2])


def twice(folder: Path) -> None:
    plain(folder)
    (folder / "again.jpg").write_bytes((folder / "1.jpg").read_bytes())


def small(folder: Path) -> None:
    plain(folder)
    Image.new("RGB", (12, 90)).save(folder / "stamp.png")


def masked(form: str, hidden: float = 0.25, size: tuple[int, int] = (64, 48), white: int = 255) -> Make:
    def make(folder: Path) -> None:
        plain(folder)
        for seed in range(4):
            columns = np.full((size[1], size[0]), white, np.uint8)
            columns[:, : round(hidden * size[0])] = 0
            path = folder / form.format(seed)
            path.parent.mkdir(exist_ok=True)
            Image.fromarray(columns).save(path)

    return make


def maps(form: str, depth: bool = False, beside: bool = False) -> Make:
    """Discs, white on black, or as depths of 16 bits; with photos beside them or alone."""

    def make(folder: Path) -> None:
        if beside:
            plain(folder)
        y, x = np.mgrid[:48, :64]
        for seed in range(4):
            disc = (x - 32 - 3 * seed) ** 2 + (y - 24) ** 2 < 200
            path = folder / form.format(seed)
            path.parent.mkdir(exist_ok=True)
            Image.fromarray((1000 + 7 * x + 500 * disc).astype(np.uint16) if depth else disc).save(path)

    return make


def of_code_page(folder: Path) -> None:
    names = [f"Снимок {k:02}.jpg" for k in range(COUNT)]
    photos(folder / "images", names)
    model(folder / "sparse/0", dict(enumerate(names)), lambda text: text.encode("cp1251"))


def colmap(folder: Path, top: str = "") -> None:
    photos(folder / top / "images")
    model(folder / top / "sparse/0")


PROGRAM_ANSWERS: dict[str, Kind] = {
    "Metashape": "used",
    "RealityScan, CSV": "used",
    "RealityScan, XMP": "used",
    "Bundler": "used",
    "OpenSfM": "used with a remark",
    "VisualSFM": "used",
    "3D Gaussian Splatting": "used",
}


def of_program(program: str, folder: Path) -> None:
    """The file of another program, of OpenSfM with two reconstructions."""
    photos(folder / "images", size=SIZE)
    PROGRAMS[program].write(folder, [viewmat(k) for k in range(COUNT)], NAMES)


def of_record3d(folder: Path) -> None:
    photos(folder / "rgbd", [f"{k}.jpg" for k in range(COUNT)], SIZE)
    record3d(folder / "metadata.json", [viewmat(k) for k in range(COUNT)], each=True)


def nsvf(folder: Path) -> None:
    plain(folder / "rgb")
    (folder / "pose").mkdir()
    (folder / "intrinsics.txt").write_text("60 32 24 0\n")
    for seed in range(4):
        (folder / f"pose/{seed}.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")


def zipped_cameras(folder: Path) -> None:
    of_program("VisualSFM", folder)
    zip_of(folder, folder / "cams.zip", only="*.nvm")
    (folder / "scene.nvm").unlink()


def zipped_with_photos(folder: Path) -> None:
    of_program("VisualSFM", folder.parent / "made")
    zip_of(folder.parent / "made", folder / "set.zip")
    plain(folder)


def r3d(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as name:
        of_record3d(Path(name))
        Path(name, "metadata.json").rename(Path(name, "metadata"))
        zip_of(Path(name), folder / "scan.r3d")


def scaled_rotations(length: float, folder: Path) -> None:
    """A COLMAP model whose quaternions have this length."""

    def change(text: str) -> bytes:
        lines = [line.split(" ") for line in text.split("\n")]
        for words in lines:
            if words[-1].endswith(".jpg"):
                words[1:5] = (repr(length * float(word)) for word in words[1:5])
        return "\n".join(map(" ".join, lines)).encode()

    photos(folder / "images")
    model(folder / "sparse/0", change=change)


def several_models(folder: Path) -> None:
    photos(folder / "images")
    model(folder / "sparse/0", dict(enumerate(NAMES[:3])))
    model(folder / "sparse/1", {k: name for k, name in enumerate(NAMES) if k > 2})


def two_sets(folder: Path) -> None:
    colmap(folder, "chair")
    colmap(folder, "table")


def renamed_case(folder: Path) -> None:
    photos(folder / "images", [name.upper() for name in NAMES])
    model(folder / "sparse/0")


def two_sizes(folder: Path) -> None:
    photos(folder / "images_2", size=(64, 48))
    photos(folder / "images_4", size=(32, 24))
    model(folder / "sparse/0")


def zipped_set(folder: Path) -> None:
    colmap(folder.parent / "made", "scene")
    zip_of(folder.parent / "made", folder / "scene.zip")


def of_windows(folder: Path, names: str = "写真 {:02}.jpg") -> None:
    made = folder.parent / "made"
    photos(made / "images", [names.format(k) for k in range(COUNT)])
    model(made / "sparse/0", {k: f"写真 {k:02}.jpg" for k in range(COUNT)})
    files = sorted(path for path in made.rglob("*") if path.is_file())
    entries = [(path.relative_to(made).as_posix().encode("cp932"), path.read_bytes()) for path in files]
    unmarked_zip.write(folder / "scene.zip", entries)


def no_camera(folder: Path) -> None:
    photos(folder / "images")
    model(folder / "sparse/0", dict(enumerate(NAMES[:-1])))


def other_names(folder: Path) -> None:
    photos(folder / "images", [f"IMG_{k}.jpg" for k in range(COUNT)])
    model(folder / "sparse/0")


def with_frames(change: Callable[[list[dict[str, object]]], object], encode: str = "utf-8") -> Make:
    def make(folder: Path) -> None:
        photos(folder / "images")
        of = frames()
        change(of)
        transforms(folder / "transforms.json", of, lambda text: text.encode(encode))

    return make


def _set(matrix: object, *numbers: int) -> Callable[[list[dict[str, object]]], object]:
    return lambda of: [of[number].update(transform_matrix=matrix) for number in numbers]


def polycam(folder: Path) -> None:
    photos(folder / "keyframes/images", [f"{k}.jpg" for k in range(COUNT)])
    (folder / "keyframes/cameras").mkdir()
    for k, frame in enumerate(frames()):
        rows = np.roll(np.array(frame["transform_matrix"])[:3], -1, axis=0)
        camera = {f"t_{i}{j}": rows[i, j] for i in range(3) for j in range(4)}
        camera |= {"fx": 60, "fy": 61, "cx": 32, "cy": 24, "width": 64, "height": 48}
        (folder / f"keyframes/cameras/{k}.json").write_text(json.dumps(camera))


def polycam_with_depth(folder: Path) -> None:
    polycam(folder)
    for kind in ("depth", "confidence"):
        (folder / "keyframes" / kind).mkdir()
    for k in range(COUNT):
        Image.fromarray(np.full((24, 32), 1500, np.uint16)).save(folder / f"keyframes/depth/{k}.png")
        Image.fromarray(np.full((24, 32), 255, np.uint8)).save(folder / f"keyframes/confidence/{k}.png")


def half_a_model(folder: Path) -> None:
    colmap(folder)
    (folder / "sparse/0/cameras.txt").unlink()


def measured(changed: Callable[[np.ndarray], np.ndarray] = lambda levels: levels, named: bool = True) -> Make:
    """The still life with depth maps in the folder depth, with their confidence."""
    return lambda folder: depth_sets.data_set(folder, 6, (96, 72), change=changed, named=named)


def with_depth(folder: Path) -> None:
    photos(folder / "images")
    for k in range(COUNT):
        Image.new("L", (64, 48)).save(folder / f"images/view {k:02}.depth.png")
    transforms(folder / "transforms.json")


def blender(folder: Path) -> None:
    for split in ("train", "val"):
        photos(folder / split, [f"r_{k}.png" for k in range(4)])
        of = [frame | {"file_path": f"./{split}/r_{k}"} for k, frame in enumerate(frames()[:4])]
        transforms(folder / f"transforms_{split}.json", of)


def with_test_set(folder: Path) -> None:
    photos(folder / "images")
    transforms(folder / "transforms.json")
    transforms(folder / "transforms_test.json", frames()[:2])


def posed_with_small(folder: Path) -> None:
    photos(folder / "images")
    transforms(folder / "transforms.json")
    Image.new("RGB", (16, 12)).save(folder / "images" / NAMES[5])


def posed_beside_zip(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as name:
        photos(Path(name) / "images")
        zip_of(Path(name), folder / "images.zip")
    transforms(folder / "transforms.json")


def posed_with_broken(folder: Path) -> None:
    photos(folder / "images")
    transforms(folder / "transforms.json")
    cut = folder / "images" / NAMES[5]
    cut.write_bytes(cut.read_bytes()[:-9])  # its size can still be read


def two_cameras(numbers: Sequence[int], folder: Path) -> None:
    photos(folder / "images")
    again = frames()
    for number in numbers:
        again[number]["transform_matrix"][0][3] += 0.5
    transforms(folder / "transforms.json", frames() + again)


def same_bytes(numbers: Sequence[int], folder: Path) -> None:
    """Photos of noise, of which those with these numbers have the bytes of the first."""
    for seed, name in enumerate(NAMES):
        _noise(folder / "images" / name, 0 if seed in numbers else seed)
    transforms(folder / "transforms.json")


def float_tiff(folder: Path) -> None:
    plain(folder)
    tags = ((258, 32), (277, 3), (339, 3))
    rows = b"".join(struct.pack("<HHII", tag, 3, 1, value) for tag, value in tags)
    (folder / "2.tif").write_bytes(b"II*\0" + struct.pack("<IH", 8, len(tags)) + rows + bytes(4))


def clear(folder: Path) -> None:
    plain(folder)
    Image.new("RGBA", (64, 48)).save(folder / "4.png")


def of_spheres(folder: Path, *, xmp: bytes = b"", with_photos: bool = False) -> None:
    for seed in range(4):
        striped(folder / f"sphere_{seed}.jpg", xmp, seed)
    if with_photos:
        plain(folder)


def spheres_with_cameras(folder: Path) -> None:
    photos(folder / "images", size=(64, 32))
    model(folder / "sparse/0")
    (folder / "sparse/0/cameras.txt").write_text("1 EQUIRECTANGULAR 64 32 64 32\n")


MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()

EXAMPLES: tuple[Example, ...] = (
    Example("Photos", "four photos called .jfif", partial(plain, suffix=".jfif"), "used"),
    Example("Photos", "one photo called x:1.jpg, one that begins with a space", spaced, "used with a remark"),
    Example("Photos", "a link to nothing, a pipe, and a link to the folder", linked, "used with a remark"),
    Example("Photos", "one photo is cut off", cut_off, "used with a remark"),
    Example("Photos", "one photo twice", twice, "used with a remark"),
    Example("Photos", "one picture of 12 x 90 pixels", small, "used with a remark"),
    Example("Photos", "one TIFF of floating-point numbers", float_tiff, "used with a remark"),
    Example("Photos", "one wholly transparent photo", clear, "used with a remark"),
    Example("Photos", "raw photos beside JPEGs", with_file("IMG_1.DNG IMG_2.DNG"), "used with a remark"),
    Example("Photos", "nothing but a raw photo", alone("IMG_1.CR3"), "refused"),
    Example("Photos", "a video beside photos", with_file("walk.mp4"), "used with a remark"),
    Example(
        "Photos",
        "results of Splatmill",
        with_file("a/model.ply a/report.json a/preview.jpg"),
        "used with a remark",
    ),
    Example("Photos", "nothing but a text", alone("notes.txt"), "refused"),
    Example("Photos", "depth maps in a folder depth", maps("depth/{}.png", True, True), "used"),
    Example(
        "Photos", "normal maps in a folder normals", maps("normals/{}.png", beside=True), "used with a remark"
    ),
    Example("Photos", "nothing but depth maps of 16 bits", maps("{}.png", True), "refused"),
    Example(
        "Photos",
        "panoramas by their XMP",
        partial(of_spheres, xmp=gpano(ProjectionType="equirectangular")),
        "used",
    ),
    Example("Photos", "panoramas by their edges alone", of_spheres, "used with a remark"),
    Example(
        "Photos",
        "panoramas beside ordinary photos",
        partial(of_spheres, xmp=gpano(ProjectionType="equirectangular"), with_photos=True),
        "used",
    ),
    Example(
        "Photos",
        "parts of panoramas beside ordinary photos",
        partial(
            of_spheres,
            xmp=gpano(
                ProjectionType="equirectangular", CroppedAreaImageHeightPixels=900, FullPanoHeightPixels=2000
            ),
            with_photos=True,
        ),
        "used with a remark",
    ),
    Example("Masks", "nothing but a folder masks", maps("masks/{}.png"), "refused"),
    Example("Masks", "nothing but masks, whatever they are called", maps("{}.png"), "refused"),
    Example("Masks", "masks/NAME.PNG", masked("masks/{}.PNG"), "used"),
    Example("Masks", "NAME_mask.png beside the photos", masked("{}_mask.png"), "used"),
    Example("Masks", "masks that hide nine tenths", masked("masks/{}.png", 0.9), "used with a remark"),
    Example("Masks", "masks of the labels 0 and 1", masked("masks/{}.png", white=1), "used with a remark"),
    Example("Masks", "masks that hide everything", masked("masks/{}.png", 1), "refused"),
    Example("Masks", "masks that belong to no photo", masked("masks/frame_{}.png"), "used with a remark"),
    Example(
        "Masks",
        "masks of another shape than the photos",
        masked("masks/{}.png", size=(64, 64)),
        "used with a remark",
    ),
    Example("Cameras", "a COLMAP model two folders down", partial(colmap, top="export/scene"), "used"),
    Example("Cameras", "the same in a zip", zipped_set, "used"),
    Example("Cameras", "a COLMAP model of panoramas", spheres_with_cameras, "used"),
    Example("Cameras", "the same in a zip by a Japanese Windows", of_windows, "used with a remark"),
    Example(
        "Cameras",
        "such a zip, where the model has other names",
        partial(of_windows, names="表 {:02}.jpg"),
        "refused",
    ),
    Example("Cameras", "sparse/0 with 3 photos, sparse/1 with 9", several_models, "used with a remark"),
    Example("Cameras", "images.txt without cameras.txt", half_a_model, "used with a remark"),
    Example(
        "Cameras", "a data set five folders down", partial(colmap, top="a/b/c/d/e"), "used with a remark"
    ),
    Example("Cameras", "two data sets side by side", two_sets, "refused"),
    Example("Cameras", "photos in another case than the model", renamed_case, "used"),
    Example("Cameras", "the photos in images_2 and images_4", two_sizes, "used with a remark"),
    Example("Cameras", "names of a model in the code page 1251", of_code_page, "used with a remark"),
    Example("Cameras", "one photo without a camera", no_camera, "used with a remark"),
    Example("Cameras", "one photo of twelve has 16 x 12 pixels", posed_with_small, "used with a remark"),
    Example("Cameras", "transforms.json beside a zip of its photos", posed_beside_zip, "refused"),
    Example("Cameras", "one photo of twelve is cut off", posed_with_broken, "used with a remark"),
    Example("Cameras", "a model of photos with other names", other_names, "refused"),
    Example(
        "Cameras", "transforms.json with a byte-order mark", with_frames(lambda of: None, "utf-8-sig"), "used"
    ),
    Example("Cameras", "one frame without a matrix", with_frames(_set(None, 5)), "used with a remark"),
    Example("Cameras", "transforms_test.json beside transforms.json", with_test_set, "used"),
    Example(
        "Cameras", "one photo of twelve with two cameras", partial(two_cameras, (3,)), "used with a remark"
    ),
    Example(
        "Cameras",
        "two photos of twelve with the same bytes and different cameras",
        partial(same_bytes, (7,)),
        "used with a remark",
    ),
    Example(
        "Cameras",
        "eight photos of twelve with the same bytes and different cameras",
        partial(same_bytes, range(8)),
        "refused",
    ),
    Example("Cameras", "two photos of twelve with two cameras", partial(two_cameras, (3, 5)), "refused"),
    Example("Cameras", "one mirrored pose of twelve", with_frames(_set(MIRRORED, 5)), "used with a remark"),
    Example("Cameras", "two mirrored poses of twelve", with_frames(_set(MIRRORED, 5, 6)), "refused"),
    Example("Cameras", "a depth picture beside each photo", with_depth, "used with a remark"),
    Example("Cameras", "depth maps in millimetres, with their confidence", measured(), "used"),
    Example("Cameras", "depth maps of no stated unit", measured(named=False), "used with a remark"),
    Example(
        "Cameras",
        "depth maps that are called millimetres and are 1/5000 m",
        measured(lambda levels: np.minimum(5.0 * levels, 65535).astype(np.uint16)),
        "used with a remark",
    ),
    Example(
        "Cameras",
        "depth maps of 8 bits, to be looked at",
        measured(lambda levels: (levels >> 6).astype(np.uint8)),
        "used with a remark",
    ),
    Example(
        "Cameras",
        "depth maps of another shape",
        measured(lambda levels: levels[:, 20:]),
        "used with a remark",
    ),
    Example("Cameras", "a Blender data set with a validation set", blender, "used with a remark"),
    Example("Cameras", "the raw data of Polycam", polycam, "used"),
    Example(
        "Cameras",
        "the raw data of Polycam, with depth maps and their confidence",
        polycam_with_depth,
        "used",
    ),
    *(
        Example("Cameras", f"cameras of {program}", partial(of_program, program), kind)
        for program, kind in PROGRAM_ANSWERS.items()
    ),
    Example("Cameras", "cameras of Record3D", of_record3d, "used"),
    Example("Cameras", "an .r3d of Record3D", r3d, "used"),
    Example("Cameras", "quaternions of a model of the length 1.04", partial(scaled_rotations, 1.04), "used"),
    Example("Cameras", "quaternions of a model of the length 2", partial(scaled_rotations, 2.0), "refused"),
    Example(
        "Cameras",
        "a reconstruction.json without cameras",
        with_file("reconstruction.json"),
        "used with a remark",
    ),
    Example("Cameras", "cameras of VisualSFM in a zip beside the photos", zipped_cameras, "used"),
    Example(
        "Cameras", "a zip of photos and such cameras beside photos", zipped_with_photos, "used with a remark"
    ),
    Example("Cameras", "cameras of NSVF", nsvf, "used with a remark"),
    Example("Cameras", "cameras of Meshroom", with_file("scene.sfm"), "used with a remark"),
)
