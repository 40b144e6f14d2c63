"""The page of inputs, from the tables that the code itself reads, and from the answers to small inputs."""

import textwrap

from docs.generate.markdown import choices, code, table

from splatmill.data_sets import CAMERA_PROGRAMS, MAX_DEPTH, OTHER_CAMERAS, PLACES
from splatmill.schema.files.formats import MODEL_FORMATS, POINT_FORMATS
from splatmill.schema.files.masks import MASK_BEGINNINGS, MASK_ENDINGS, MASK_FOLDERS
from splatmill.schema.files.names import MAX_PART_BYTES, MAX_PARTS
from splatmill.schema.files.other_pictures import CONFIDENCE, DEPTH, OTHER_FOLDERS, UNUSED
from splatmill.schema.files.outputs import OUTPUT_MARKS, OUTPUT_MEDIA
from splatmill.schema.files.photos import (
    ARCHIVE_SUFFIXES,
    MAX_PHOTO_PIXELS,
    MIN_PHOTO_SIDE,
    PHOTO_FORMATS,
    UNREAD_KINDS,
    VIDEO_FORMATS,
)
from splatmill_worker.images import depth_maps, guarded, mask_levels, prepare
from splatmill_worker.images.archives import archive, zip_names
from splatmill_worker.images.colors.colors import PRIMARIES, TRANSFERS, Colors
from splatmill_worker.images.colors.photo_colors import PhotoColors
from splatmill_worker.images.lens import PANORAMA, PINHOLE_MODELS
from splatmill_worker.images.no_photo import TRAITS
from splatmill_worker.images.overlays import overlay
from splatmill_worker.images.panoramas import faces, panoramas
from splatmill_worker.pipeline import scan_fit
from splatmill_worker.pipeline.depth import given_depth
from splatmill_worker.readers import scan
from splatmill_worker.readers.colmap_files import MODELS
from splatmill_worker.readers.programs.shots import MAX_LENGTH_ERROR
from splatmill_worker.scene import MIN_SHOWN
from splatmill_worker.sfm.depth import pixels, unit
from splatmill_worker.sfm.depth import points as depth_points
from splatmill_worker.sfm.posed import colmap_model, model_files, polycam, same_bytes
from splatmill_worker.sfm.posed.judged import points, triangulation
from tests.support.inputs.example import answer
from tests.support.inputs.table import EXAMPLES


def page() -> str:
    """The page of inputs."""
    parts = [
        *_introduction(),
        *_photos(),
        *_masks(),
        *_cameras(),
        *_points(),
        *_depth(),
        *_models(),
        *_answers(),
    ]
    return "\n".join(part if part.startswith(("#", "|")) else _filled(part) for part in parts)


def _filled(text: str) -> str:
    """Paragraphs in lines of equal length, whatever the values in them."""
    paragraphs = (
        textwrap.fill(" ".join(part.split()), 120, break_on_hyphens=False) for part in text.split("\n\n")
    )
    return "\n\n".join(paragraphs) + "\n"


def _introduction() -> list[str]:
    return [
        "# Inputs\n",
        """What `splatmill train PATH`, the SDK and the web page read, what is assumed, and what is refused. This page
        is made from the tables that the program itself reads. The answers at its end are those that the program gives
        while the page is made. [Photographing for splats](photographing.md) says how to take photos, and
        [Formats](formats.md) what models hold.

        PATH is a video, a zip, or a folder of photos, with or without their cameras. For a file of cameras, such as
        `transforms.json` or `database.db`, and for a folder of a COLMAP model in a data set, such as `sparse/0`,
        the data set around it is taken. The command says before the training, and the web page before the upload,
        which files are not used. What the job leaves out is in `report.json` and on the page of the report; a
        warning there says what is probably wrong. The log has the rest.""",
    ]


def _photos() -> list[str]:
    return [
        "## Photos\n",
        table(
            ["format", "suffixes"], [[name, choices(suffixes)] for name, suffixes in PHOTO_FORMATS.items()]
        ),
        f"""Suffixes count in either case. A file in a zip is recognised by its content. The EXIF orientation is
        applied. Of a file with several pictures, the first is used. Hidden files and folders are ignored, and
        so are {choices(prepare.IGNORED_NAMES)}. A photo is left out, with the reason, if it is damaged or cut
        off, has the same bytes as another one, has a side under {MIN_PHOTO_SIDE} pixels, or more than
        {MAX_PHOTO_PIXELS // 10**6} million pixels, or is wholly transparent. Opaque photos among cut-outs are
        named in a warning, and used. Of photos that are copies of one another, the largest is used, and what
        never moves in {overlay.MIN_PHOTOS} or more photos is masked
        ([Photographing](photographing.md#copies-near-copies-and-what-never-moves)).

        Photos without EXIF are taken to be of one camera for each folder and each video. Where the motion of the camera
        does not determine them, pixels are taken to be square, and the focal length to be that of EXIF, or else 1.2
        times the longest side.

        A photo is a panorama if its XMP says so (`GPano:ProjectionType`, equirectangular), or if it is twice as wide as
        high, its left and right edges meet (up to {panoramas.SEAM:g} times the difference of two columns), and its top
        and bottom are of one colour (up to {panoramas.POLES:.0%} of the differences of other rows); a warning says
        where that is assumed. Where only its left and right edges meet, its folder decides, and a warning names both
        readings. Panoramas may lie beside other photos, and are trained as the
        {len(faces.FACES)} faces of a cube ([Photographing](photographing.md#360-degree-photos)).

        A file whose name cannot be stored (`x:1.jpg`, a space at an end, bytes that are not UTF-8) is stored under a
        similar name, and both names are given. A path of more than {MAX_PARTS} parts is left out; a part of more than
        {MAX_PART_BYTES} bytes is shortened. Links are followed, to each folder once. A link to nothing, a pipe, a
        socket or a device, and what may not be read or disappears before it is read, is left out by name.""",
        "### Videos\n",
        table(
            ["container", "suffixes"], [[name, choices(suffixes)] for name, suffixes in VIDEO_FORMATS.items()]
        ),
        f"""A video is read up to {guarded.MAX_VIDEO_SECONDS / 3600:.0f} hours, with frames of up to
        {guarded.MAX_FRAME_PIXELS // 10**6} million pixels. Videos and zips in a folder are used only where it has no
        photos.""",
        "### Colours\n",
        table(
            ["in the file, by its number in H.273", "read as"],
            [*_codes("primaries", PRIMARIES), *_codes("transfer", TRANSFERS)],
        ),
        f"""Colours are brought to sRGB with 8 bits per channel. A photo is read by its ICC profile, or else by its
        tags, the chunks sRGB, gAMA and cHRM of PNG, or EXIF (Adobe RGB, other primaries, a power); in a PNG, cICP comes
        first. A video is read by its tags. PQ and HLG are converted by one rule, which
        [Photographing](photographing.md#what-can-be-given) has. Photos of 10 or 16 bits are reduced to 8 before that,
        by less than one level: neighbouring tones are then up to
        {PhotoColors(tags=Colors("BT.2020", "PQ")).largest_step()} levels apart for PQ, and up to
        {PhotoColors(tags=Colors("sRGB", "linear")).largest_step()} in the shadows of linear light, and the report says
        so. Of a photo with a gain map, the SDR picture is used. CMYK and LAB are converted too. Grey
        floating-point numbers are taken as sRGB from 0 to 1, and left out if they reach further; coloured ones are
        refused, since they may be linear light as well. The report says what was converted or assumed.""",
        "### Zips\n",
        f"""{choices(ARCHIVE_SUFFIXES)} files hold photos or a whole data set. All zips and videos of a capture together
        hold up to {archive.MAX_ENTRIES:,} files. A zip in a zip is not unpacked. A zip among photos without cameras
        that holds cameras and no photos gives them theirs; where it has photos too, or other cameras lie beside the
        photos, a sentence names its cameras.

        Names that do not say that they are UTF-8, and are not, are read in the encoding that makes them those which the
        cameras name. Without cameras, it is the first one in which they are words of its language; a warning then has
        another reading too. The order is {choices(zip_names.ENCODINGS)}.""",
        "### Photos, videos and archives that are not read\n",
        table(
            ["what", "suffixes", "what to do"],
            [[kind.what, choices(kind.suffixes), kind.advice] for kind in UNREAD_KINDS],
        ),
        f"""Results of Splatmill among the photos are not read: the files {choices(OUTPUT_MEDIA)} in a folder
        with two of {choices(OUTPUT_MARKS)}.""",
        "### Pictures that are no photos\n",
        table(
            ["what", "folders, in either case", "by their pixels"],
            [
                [what, choices(f"{name}/" for name in names), TRAITS.get(what, "")]
                for what, names in OTHER_FOLDERS.items()
            ],
        ),
        f"""Without cameras, pictures in folders of {", ".join(UNUSED)} are not used where photos lie beside
        them, and a sentence names them; masks and [depth maps](#depth-maps) are used, and thumbnails compared with the
        photos. If all pictures lie in such folders, or PATH is one, both readings are named and nothing is
        trained. The job fails too, whatever the folder is called, if all pictures are of these kinds by their
        pixels. A picture with a single channel of 16 bits among photos in colour is left out.""",
    ]


def _codes(kind: str, names: dict[int, str]) -> list[list[str]]:
    return [
        [f"{kind} {', '.join(str(number) for number, name in names.items() if name == read)}", read]
        for read in dict.fromkeys(names.values())
    ]


def _masks() -> list[str]:
    folders = choices(f"{folder}/a.png" for folder in MASK_FOLDERS)
    endings = choices(f"a{ending}.png" for ending in MASK_ENDINGS)
    whole = choices(f"a.jpg{ending}.png" for ending in ("", *MASK_ENDINGS))
    beginnings = choices(f"{beginning}a.png" for beginning in MASK_BEGINNINGS)
    rows = [
        ["in a folder of masks, at any depth", f"{folders}, or a name of the next row"],
        ["beside its photo", f"{endings}, {beginnings}, {whole}"],
    ]
    return [
        "## Masks\n",
        table(["where", "the mask of `a.jpg`"], rows),
        f"""Case does not matter, and neither does the suffix, if it is that of a photo. A picture with such a name
        beside the photos is a photo where no photo has the rest of its name. Where the folders of masks and photos
        differ, a file name that occurs once is enough.

        Pixels darker than {MIN_SHOWN} of 255 are hidden; in a mask with transparent pixels, these are. If all masks
        together have two levels, both darker or both lighter than that, as pictures of labels 0 and 1 have, the lower
        one hides and the higher one shows, and a warning says so. Masks that hide all of every photo end the job; one
        that hides all of its photo is named. A mask of another shape than its photo is not used. The log
        says how many photos have a mask and what share of their pixels the masks hide. A warning names masks that
        belong to no photo. Another is given for masks that hide more than {mask_levels.MAX_HIDDEN:.0%} of the pixels of
        all photos, which are probably inverted. Where a photo is transparent, it is hidden too.""",
    ]


def _cameras() -> list[str]:
    fields = choices((*polycam.INTRINSICS, "k1", "k2", "k3", "k4", "p1", "p2"))
    return [
        "## Photos with cameras\n",
        table(
            ["program", "files, in either case"],
            [[program, choices(names)] for program, names in CAMERA_PROGRAMS.items()],
        ),
        f"""Given cameras are used as they are, and are not recovered again. A data set lies in the given folder or up
        to {MAX_DEPTH} folders down; of two side by side, none is used, and both are named. A COLMAP model is
        preferred to the other files, which a warning names. Its folder is the given one or one of {choices(PLACES)}
        in it, where N is a number, and what is in brackets may be missing. `images` is needed beside `cameras`,
        both as `.bin` or both as `.txt`; `points3D` may be missing. Of several models, up to
        {colmap_model.MOST_MODELS}, the one with the most of the photos is used, and a warning names the others.
        Text may have a byte-order mark, any line ends, and names with spaces. Names that are not UTF-8 are read in the
        one of the encodings of zips in which the most of them are photos, and a warning says in which; where two lead
        to different photos, the job fails and names both.

        In `transforms.json`, a frame or the document has {fields}. `camera_angle_x` and `camera_angle_y` may stand for
        the focal lengths; a size that is missing is that of the photo. `fx`, `fy`, `width` and `height` mean the same
        as `fl_x`, `fl_y`, `w` and `h`; where both are there and differ, the frame is faulty, and both are named.
        `transform_matrix` is from camera to world, 4 x
        4 or 3 x 4, with OpenGL axes; the fourth row is 0, 0, 0, 1. `mask_path` names the mask of a frame, in any
        folder of the data set; a warning says how many are missing. Where frames name photos beside the folder
        `images`, those are used too. Of the raw data of Polycam, corrected cameras are preferred, which need the photos
        in `keyframes/corrected_images`. Tested forms are those of nerfstudio, of instant-ngp, of NeRFCapture and
        Record3D (each frame with its lens, names without suffix), of Polycam's polyform, and those with `camera_model`
        PINHOLE and a lens for each frame, which stand for Luma AI, whose export has no public description: all have
        the cameras of the same COLMAP model, exactly.

        `transforms_train.json`, `transforms_test.json` and `transforms_val.json` are read, beside a `transforms.json`
        too, and so are the lists `train_filenames`, `test_filenames` and `val_filenames` in a file: those to test with
        are held out, and those of the validation set left out, unless they are also for training. Other files
        `transforms*.json` are read only where there is no `transforms.json`. A photo that is named several times has
        one camera: where the cameras agree, any of them; where they differ, the photo is left out, and both are named.
        If those are more than {model_files.MOST_FAULTY:.0%} of the photos, the job fails. Photos of the same bytes with
        different cameras are left out too, since at most one of the cameras can be right, and a warning names them; if
        they are more than {same_bytes.MOST_CONTRADICTED:.0%} of the photos, the job fails. Photos of one colour are
        kept.

        A photo is found by the name that its camera gives. Where none has it, the photo is the one that agrees in the
        last parts of its path, with `/` or `\\` between folders, in another case, form of accents or suffix, if it is
        the only one. Of the same photos in several sizes, as in `images_2` and `images_4`, the largest are used. A
        camera may be of another size than its photo, with the same shape up to {colmap_model.MAX_ASPECT_ERROR:.0%}.

        Cameras of other programs are used where there is neither a COLMAP model nor a `transforms.json`. Their files
        may lie in any folder, and are recognised by what is in them. Of two files of one program, the one in the outer
        folder is used; where both lie equally deep, the job fails and names them. Photos are found by the names in the
        file, with or without their suffix.

        - **Metashape**: File > Export > Export Cameras, as Agisoft XML. Lenses of the types frame and fisheye are
        read, with f, cx, cy, b1, k1 to k4, p1 and p2; a skew b2 is left out where it moves corners by less than half a
        pixel, and else refused. Of several chunks or components, the one with the most cameras is used. Cameras far
        from the origin, as on the earth, are moved to it. Those of rigs are left out.

        - **RealityScan and RealityCapture**: the CSV of internal and external camera parameters (name, x, y, alt or z,
        heading, pitch, roll, f, px, py, k1 to k4, t1, t2), which Postshot takes too, or an XMP beside each photo. The
        rotation of a CSV is Rz(-heading) Rx(pitch) Ry(roll), from a camera with OpenGL axes to the world. t1 is taken
        as the coefficient of r² + 2x². Of the lenses of an XMP, perspective and brown are read.

        - **OpenSfM and OpenDroneMap**: `reconstruction.json`, with its points; lenses of the types perspective, brown,
        radial, simple_radial, fisheye and fisheye_opencv. Of several reconstructions, the one with the most photos.

        - **Bundler**, as COLMAP, RealityScan, Metashape and others write it too: version 0.3, with its points. The
        names of the photos are in a list beside it, such as `list.txt`, which is needed.

        - **VisualSFM**, as COLMAP writes it too: `.nvm` of the versions NVM_V3 and NVM_V3_R9T, with its points; a
        calibration of all photos (FixedK) is refused. Of several models, the one with the most photos is used.

        - **3D Gaussian Splatting**, of Inria and trainers like it: the `cameras.json` of a trained model, beside its
        photos, without its points. The principal point is the middle of the photo.

        - **Record3D**: the `.r3d`, or its folder or an export with `metadata.json`, with the photos called by their
        numbers. The depth maps in an `.r3d` are compressed (LZFSE) and not read; those of its export as EXR are not
        read either.

        A frame without a matrix is left out with a warning. Up to {model_files.MOST_FAULTY:.0%} of the poses are left
        out if no camera can have them (mirrored, sheared, not finite); with more, the job fails and names the first. It
        fails also if no photo has a camera, or if a file with cameras cannot be read. Quaternions are brought to the
        length 1; one whose length differs from it by more than {MAX_LENGTH_ERROR:.0%} is no rotation.""",
        "### Lenses\n",
        table(
            ["COLMAP's model", "parameters", "photos"],
            [[code(name), str(count), _undistorted(name)] for name, count in MODELS.values()],
        ),
        "### Cameras that are not read\n",
        table(
            ["program", "files, in either case"],
            [[program, choices(names)] for program, names in OTHER_CAMERAS.items()],
        ),
        "Cameras are then recovered from the photos, and a sentence names the file, in the report too.",
    ]


def _undistorted(model: str) -> str:
    if model == PANORAMA:
        return "cut into the faces of a cube"
    if model in PINHOLE_MODELS:
        return "as they are"
    return "undistorted to a pinhole, or where wide to faces"


def _points() -> list[str]:
    return [
        "## Points\n",
        f"""Points are those of the COLMAP model, or of the `.ply` in the data set that `ply_file_path` in
        `transforms.json` names, whose faces and lists are left out. Points with tracks are used; if the photos
        that the tracks name do not show their colours, photos are matched to check the cameras. Points without tracks,
        such as a laser scan (up to {points.MOST_LOOSE:,} of them), are used where photos show their colours; if photos
        show these hardly more often than by chance, none is used, and the log says so. With fewer than
        {points.LEAST_POINTS}, points are triangulated with the given cameras. A warning says when the cameras explain
        less than {triangulation.CONTRADICTED:.0%} of the matches between photos: then the poses or the intrinsics are
        wrong, or belong to other photos. It names another convention of axes or matrices in which they fit, if one
        does.""",
        """`--start scan.laz` names a file of points that are used beside all these. It may be a `.ply` or one of the
        formats below, of which all but text need `pip install 'splatmill-worker[scans]'`. The page takes one of these
        that is dropped with the photos as such a file, unless it is left out there:""",
        table(["suffix", "format"], [[code(suffix), name] for suffix, name in POINT_FORMATS.items()]),
        f"""If cameras came with the photos, the points may be in their coordinates, and the photos judge them
        as above. If not, or if they do not fit so, points with colours are aligned by a similarity to the
        points of the photos: any scale, turn and offset, also where the scan has only a part of the scene,
        or much more. Offsets such as those of UTM are kept in float64. The report has the matrix, the
        scale, the share of the points of the photos that lie on the scan, and their median distance from it
        in units of the file (`given_points_alignment`). An aligned scan is used if the photos show its
        colours at least {scan_fit.LEAST_SHARE:.0%} as often, above chance, as those of the scene's own
        points. Otherwise the job is refused with these numbers, as it is for a mirrored scan, which no
        similarity turns right. Points without colours are not aligned; in the coordinates of given cameras,
        they get the median colour of the photos that see them, if photos agree on these more than by
        chance.

        The coordinates of an `.e57` are metres by its standard. If the cameras were recovered and neither
        GPS nor `scale` gives a unit, the model is then in metres. Those of other formats may be anything.

        Of more than {scan.MOST:,} points, evenly chosen ones are read. Of these, one stays for each pixel
        of the photo that shows its place closest, or for each of larger cells where more would stay than
        {scan_fit.STARTED:.0%} of the Gaussians that the photos resolve, {scan_fit.FEW:,} in any case and
        {points.MOST_LOOSE:,} at most. The log has the numbers.""",
    ]


def _depth() -> list[str]:
    few = unit.READINGS
    return [
        "## Depth maps\n",
        f"""Depth maps of phones and RGB-D cameras beside the photos give points to start from, in addition to those
        above. The map of `images/a.jpg` is `depth/a.png` in one of the folders
        {choices(f"{name}/" for name in OTHER_FOLDERS[DEPTH])}, at any depth, or what a frame of `transforms.json` has
        as `depth_file_path` (nerfstudio) or `depth_path` (instant-ngp, NeRFCapture). The map of a frame of a video is
        called by the number of the frame. A map of
        confidence has the same name in {choices(f"{name}/" for name in OTHER_FOLDERS[CONFIDENCE])}. The page takes them
        in a folder or a zip, as the command does.

        A map is a PNG or TIFF with a single channel of 16 bits, or of 32 as integers or floating-point numbers: the
        distance along the optical axis. It has the shape of its photo, and any size. 0, {depth_maps.LARGEST} of 16
        bits, and what is not finite is no distance. A map is left out by name if it is cut off, empty, of another
        shape, or of 8 bits or in colours, as maps are that are drawn to be looked at.

        Pixels count if their confidence is the highest that occurs in the maps of the capture (2 of 0, 1 and 2, as of
        Stray Scanner; 255 of 0, 54 and 255, as of Polycam; with more than {given_depth.FEW_LEVELS} levels, from half of
        the highest), and if they differ from their neighbours by less than {pixels.EDGE:.0%}. Of all maps together, up
        to {depth_points.MOST:,} evenly chosen pixels become points, in float64, with the colour of their photo there.
        They are thinned as a scan is. Those stay whose colour another photo shows; if the other photos do so less than
        {scan_fit.LEAST_SHARE:.0%} as often, above chance, as for the scene's own points, none is used. Maps of held-out
        photos and of panoramas are not read.

        The unit of the maps is measured: it is the median ratio of the depths of the scene's own points and the levels
        at them. If half of the ratios differ from it by more than {unit.SPREAD:.0%}, no map is used; a map in which
        they do is left out. A unit that is stated (`depth_unit_scale_factor`, `integer_depth_scale`; a millimetre by
        default where frames name
        maps, as in nerfstudio, and in Polycam's raw data) is used as it is if it is the same up to {unit.SAME:.0%}; if
        it is not, the measured one is used, and the log has both. With fewer than {unit.FEWEST} such points, a
        stated unit is used, and maps without one are not: a sentence names their distances in {" and in ".join(few)}.
        So maps may be in millimetres, as of Polycam, Stray Scanner, ScanNet and Redwood, or in 1/5000 m, as of TUM
        RGB-D, if their names are those of the photos.

        Recovered cameras are treated alike. If nothing else gives a unit to the model, maps with confidence give it
        metres, since phones write millimetres. No depth map ends a job: the report says in a warning why none is
        used, and has the numbers (`depth_maps`, `depth_unit`, `depth_points_used`). Maps beside their photos
        (`a.depth.png`), in `.npy`, `.pgm` or EXR, and those of TUM RGB-D whose names are other times than those of the
        photos, are not read.""",
    ]


def _models() -> list[str]:
    return [
        "## Model files\n",
        table(
            ["suffix", "format"],
            [[code(form.suffix), form.name] for form in MODEL_FORMATS.values() if form.readable],
        ),
        """`splatmill convert`, `render`, `orbit` and `clean` read these, and a training may start from one (`--start`).
        [Variants of the .ply](formats.md#variants-of-the-ply) has what is read otherwise than it stands in a file, or
        not at all. -y is up in a `.ply`.""",
    ]


def _answers() -> list[str]:
    parts = ["## What is answered\n"]
    for area in dict.fromkeys(example.area for example in EXAMPLES):
        answers = [(example.what, answer(example.make)) for example in EXAMPLES if example.area == area]
        rows = [[what, reply.kind, " ".join(reply.said)] for what, reply in answers]
        parts += [f"### {area}\n", table(["input", "answer", "message"], rows)]
    return parts
