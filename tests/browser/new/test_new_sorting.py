"""The page at `/` sorts files as the command line does: photos, masks, cameras, points, and what it says of the others.

Not proved here: what becomes of them after the upload (test_new).
"""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path

import pytest
from playwright.sync_api import Page

from splatmill.errors import NothingToUpload
from splatmill.transfer.local_capture import find_files
from tests.browser.new.test_new import opened

TREES = {
    "photos in folders": "b.JPG a.heic day/c.png notes.txt .hidden/d.jpg ._a.jpg __MACOSX/e.jpg walk.mp4",
    "masks": "images/a.jpg images/left/b.jpg masks/a.jpg.png masks/left/b.png masks/readme.txt d.jpg",
    "mask": "a.jpg mask/a.png",
    "masks of other programs": "a.jpg a_mask.png b/c.jpg b/C.mask.PNG Mask_a.png a.jpg.png b/gas_mask.jpg _mask.png",
    "folders of masks": "images/a.jpg images/Mask/a.PNG Masks/b/a.png segmentation/a.png cam/masks/a.jpg",
    "results": "a.jpg splat/model.ply splat/report.json splat/preview.jpg splat/report.png splat/own.jpg preview.jpg",
    "results of a video": "walk.mp4 out/model.ply out/report.json out/orbit.mp4 out/cameras.zip out/cameras.json",
    "only masks": "mask/a.jpg mask/b.jpg",
    "only maps": "scan/depth/a.png scan/Normals/a.png",
    "maps beside photos": "rgb/a.jpg depth/a.png depth/b.png confidence/a.png thumbs/a.jpg",
    "maps beside photos with cameras": "rgb/a.jpg depth/a.png transforms.json",
    "colmap": "images/a.jpg sparse/0/cameras.bin sparse/0/images.bin sparse/0/project.ini sparse/1/cameras.bin",
    "colmap in its root": "images/a.jpg cameras.txt images.txt points3D.txt frames.txt",
    "colmap of nerfstudio": "images/a.jpg colmap/sparse/0/cameras.bin colmap/sparse/0/points3D.bin transforms.json",
    "blender": "train/r_0.png test/r_0.png transforms_train.json transforms_test.json deep/transforms.json",
    "a data set one folder down": "scene/images/a.jpg scene/sparse/0/cameras.bin scene/sparse/0/images.bin "
    "scene/masks/a.png note.txt",
    "masks some folders down": "masks/set/images/a.jpg masks/set/images/b.jpg masks/set/images/b_mask.png "
    "masks/set/segmentation/a.png masks/set/transforms.json masks/other.png",
    "masks without a folder of photos some folders down": "set/a.jpg set/a_mask.png set/transforms.json b_mask.png",
    "models of a mapper": "images/a.jpg sparse/10/cameras.txt sparse/2/cameras.txt "
    "sparse/cameras.txt colmap/sparse/0/cameras.txt",
    "cameras beside the photos": "photos/a.jpg out/sparse/0/cameras.bin out/sparse/0/images.bin extra/cameras.txt",
    "other cases": "Scene/images/A.JPG Scene/Transforms.JSON",
    "numbered models": "a.jpg 0/cameras.bin 1/cameras.bin 1/images.bin",
    "too deep": "a.jpg 1a/2a/3a/4a/5a/transforms.json",
    "raw data of Polycam": "keyframes/images/1.jpg keyframes/cameras/1.json keyframes/corrected_images/1.jpg "
    "keyframes/corrected_cameras/1.json keyframes/depth/1.png mesh_info.json",
    "raw data of Polycam some folders down": "x/Scan/Keyframes/images/1.jpg x/Scan/Keyframes/cameras/1.json x/raw.glb",
    "cameras beside a video": "clip.mp4 C0001M01.XML cameras.csv",
    "kinds that are not read": "a.jpg b.DNG c.dng old.bmp photos.rar x/VID_1.insv film.mts clip.mp4",
    "cameras that are not read": "images/a.jpg a/scene.SFM scan.nvm b.rd x.mvs temple_par.txt",
    "cameras of other programs": "images/a.jpg images/a.xmp opensfm/Reconstruction.json cameras.XML scan.nvm "
    "bundle.out list.txt bundle.list.txt notes.txt r.csv c.lst",
    "cameras of trainers": "images/a.jpg cameras.json pose/0.txt other/0.txt a/POSE/1.txt camera/0.json poses.txt",
    "cameras of a result": "a.jpg splat/cameras.json splat/model.ply",
    "cameras in a zip": "a.jpg cams.zip:scene.nvm,__MACOSX/a.nvm old.zip:notes.txt",
    "cameras in zips with photos or beside others": "a.jpg b.r3d:metadata,rgbd/0.jpg c.zip:Keyframes/cameras/1.json "
    "transforms.json",
    "a zip of cameras that are not read": "x/a.jpg x/cams.zip:set/pose/1.txt,set/readme.md",
    "lists without cameras": "a.jpg list.txt c.lst",
    "cameras of other programs without photos": "walk.mp4 cameras.xml scan.nvm",
    "half a model": "images/a.jpg sparse/0/images.txt sparse/0/points3D.txt",
    "cameras that are not needed": "images/a.jpg transforms.json cameras.xml",
    "videos": "a.mov b.webm",
    "depth maps": "rgb/a.jpg depth/a.png Confidence/a.png normals/a.png",
    "depth maps of a video": "rgb.mp4 depth/000000.png confidence/000000.png odometry.csv",
    "nothing but depth maps and masks": "depth/a.png masks/a.png",
    "a zip": "photos.zip",
    "code points": "é.jpg Z.jpg a.jpg \U0001f600.jpg ﬁ.jpg",
}


TRANSFORMS = {
    "masks that frames name": json.dumps(
        {
            "ply_file_path": "./points.ply",
            "frames": [
                {"file_path": "images/a.jpg", "mask_path": "sam/obj_0.png"},
                None,
                {"file_path": "images/b.jpg", "mask_path": ".\\images\\obj_1.png"},
            ],
        }
    ),
    "depth maps that frames name": json.dumps(
        {
            "frames": [
                {"file_path": "images/a.jpg", "depth_file_path": "sensor/a.png"},
                {"file_path": "images/b.jpg", "depth_path": "sensor/b.png"},
            ]
        }
    ),
    "photos that frames name": json.dumps(
        {"frames": [{"file_path": "images/a.jpg"}, {"file_path": "more/b.jpg"}]}
    ),
}
TRANSFORMS |= {
    f"names as in addresses, in {encoding}": json.dumps(
        {
            "ply_file_path": "my%20points.ply",
            "frames": [{"file_path": "a.jpg", "mask_path": "my%20sam/a%20b.png"}],
        }
    )
    for encoding in ("utf-8-sig", "utf-16", "utf-16-be", "utf-32", "utf-32-le")
}
TREES |= {
    title: "images/a.jpg my%sam/a%b.png my%points.ply other.ply transforms.json".replace("%", "\0")
    for title in TRANSFORMS
    if title.startswith("names")
}
TREES |= {
    "masks that frames name": "set/images/a.jpg set/images/b.jpg set/images/obj_1.png set/sam/obj_0.png "
    "set/sam/other.png set/points.ply set/transforms.json",
    "depth maps that frames name": "set/images/a.jpg set/images/b.jpg set/sensor/a.png set/sensor/b.png "
    "set/depth/b.png set/transforms.json",
    "photos that frames name": "images/a.jpg more/b.jpg more/c.jpg transforms.json",
}


def test_files_are_sorted_as_by_the_command_line(page: Page, tmp_path: Path) -> None:
    opened(page)
    script = """async ([paths, texts, zipped]) => {
      const { documentsIn } = await import("/page/any/new/documents.js");
      const { sort } = await import("/page/any/new/kinds.js");
      const { remarks } = await import("/page/any/new/remarks.js");
      const { listsIn } = await import("/page/any/new/zip.js");
      const { accepted } = await (await fetch("/v1/info")).json();
      const file = (path, bytes) => new File([new Uint8Array(bytes)], path);
      const given = Object.entries(texts).map(([path, bytes]) => ({ path, file: file(path, bytes) }));
      const zips = Object.entries(zipped).map(([path, bytes]) => ({ path, file: file(path, bytes) }));
      const sorted = sort(paths, accepted, await documentsIn(given), await listsIn(zips, accepted.archives));
      return { ...sorted, others: [], remarks: remarks(sorted, accepted) };
    }"""
    for title, names in TREES.items():
        root = tmp_path / title
        encoding = title.rpartition(" in ")[2] if title.startswith("names") else "utf-8"
        content = TRANSFORMS.get(title, "x").encode(encoding)
        # What follows a colon is in the zip of that name.
        trees = dict(name.replace("\0", " ").partition(":")[::2] for name in names.split())
        paths = list(trees)
        for name, inside in trees.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_bytes(content)
            if inside:
                with zipfile.ZipFile(root / name, "w") as archive:
                    for each in inside.split(","):
                        archive.writestr(each, "x")
        zipped = {name: list((root / name).read_bytes()) for name, inside in trees.items() if inside}
        texts = {name: list(content) for name in paths if title in TRANSFORMS and "json" in name}
        here = page.evaluate(script, [paths, texts, zipped])
        if here["problem"] is not None:
            with pytest.raises(NothingToUpload, match=re.escape(here["problem"])):
                find_files(root)
            continue
        upload = find_files(root)
        listed = [(file["role"], file["name"], file["path"]) for file in here["files"]]
        assert listed == [
            (file.role.value, file.name, file.path.relative_to(root).as_posix()) for file in upload.files
        ], title
        assert here["ignored"] == list(upload.ignored), title
        assert here["outputs"] == list(upload.outputs), title
        assert here["remarks"] == list(upload.remarks), title
