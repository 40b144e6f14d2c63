"""The worker's programs: `python -m splatmill_worker train | renderer | render-file | fit-image | ...`."""

import argparse
import ctypes
import importlib.util
import os
import sys
from pathlib import Path

from splatmill.garbage import uncollected

SPIN_COUNT = "1000"
"""GOMP_SPINCOUNT: how often a thread polls at a barrier of the kernels before it sleeps. Under OpenMP's default it
polls for milliseconds, and occupies the core that the awaited thread needs (decisions: SPIN_COUNT)."""

MMAP_THRESHOLD = 8 * 2**20
"""Size in bytes from which glibc maps memory for an allocation alone, and returns it to the system when it is freed.
Without it, glibc raises the size to 32 MiB by itself (decisions: MMAP_THRESHOLD)."""


def main(argv: list[str] | None = None) -> int:
    """Run one of the worker's programs and return its exit status."""
    parser = argparse.ArgumentParser(prog="python -m splatmill_worker", description=__doc__)
    programs = parser.add_subparsers(dest="program", required=True)
    train = programs.add_parser(
        "train", help="run jobs from the queue (set REDIS_URL, SPLATMILL_STORAGE and SPLATMILL_DATA)"
    )
    train.add_argument(
        "--stop-grace", type=float, help="seconds that a job has to save its state when the worker is stopped"
    )
    train.add_argument(
        "--queues",
        help="the queues to serve, separated by commas: any, cpu, gpu (default: SPLATMILL_QUEUES, or all that this "
        "machine can run)",
    )
    renderer = programs.add_parser("renderer", help="render stored models on request over HTTP")
    renderer.add_argument("--host", default="127.0.0.1")
    renderer.add_argument("--port", type=int, default=8090)
    renderer.add_argument("--uds", type=Path, help="listen on this unix socket instead of host and port")
    renderer.add_argument(
        "--fd", type=int, help="listen on the inherited socket with this file descriptor instead"
    )
    renderer.add_argument(
        "--backend", choices=["reference", "cpu", "gpu"], help="kernels to render with (default: cpu)"
    )
    for name, what in (("render-file", "an image"), ("orbit-file", "a video")):
        file = programs.add_parser(name, help=f"render {what} of a model file on this machine")
        file.add_argument("model", type=Path)
        file.add_argument("--out", type=Path, required=True)
        file.add_argument("--request", default="{}", help="the request of the REST API as JSON")
        file.add_argument("--cameras", type=Path, help="cameras.json of the model")
        file.add_argument("--width", type=int, help="width in pixels of an image without a camera")
        file.add_argument("--up", default="-y", help="axis that points up, for a model without cameras")
    convert = programs.add_parser("convert-file", help="convert a model file to other formats")
    convert.add_argument("model", type=Path)
    convert.add_argument("outs", type=Path, nargs="+")
    convert.add_argument("--photos", type=Path, help="folder of the photos, to compare with")
    clean = programs.add_parser("clean-file", help="remove what its photos do not support from a model file")
    clean.add_argument("model", type=Path)
    clean.add_argument("--out", type=Path, required=True)
    clean.add_argument("--capture", type=Path, help="folder of the photos")
    clean.add_argument("--edit", help="EditModel as JSON")
    clean.add_argument("--min-weight", type=float, help="least weight in some photo, pixels")
    clean.add_argument("--image-size", type=int, help="longest side of the photos, pixels")
    mesh = programs.add_parser("mesh-file", help="make a mesh of a model file")
    mesh.add_argument("model", type=Path)
    mesh.add_argument("--out", type=Path, required=True)
    mesh.add_argument("--cameras", type=Path, help="cameras.json of the model")
    mesh.add_argument("--faces", type=int, required=True, help="most triangles")
    mesh.add_argument("--voxel", type=float, help="side of a voxel, units of the model")
    mesh.add_argument("--box", help="lower and upper corner as JSON")
    mesh.add_argument("--texture", type=int, help="longest side of a texture in pixels")
    mesh.add_argument("--up", default="-y", help="axis that points up, for a model without cameras")
    mesh.add_argument(
        "--backend", choices=["reference", "cpu", "gpu"], help="kernels to render with (default: cpu)"
    )
    mesh.add_argument("--parent", type=int, help="process that reads lines of JSON, with which this one ends")
    text = programs.add_parser("model-text", help="turn the files of a COLMAP model from binary to text")
    text.add_argument("folder", type=Path)
    fit_image = programs.add_parser("fit-image", help="fit one image by Gaussians in a plane")
    fit_image.add_argument("photo", type=Path)
    fit_image.add_argument("--out", type=Path, required=True, help="folder for the results")
    fit_image.add_argument("--options", default="{}", help="FitImageOptions as JSON")
    plan = programs.add_parser("plan", help="make a plan of a scene in tiles")
    plan.add_argument("folder", type=Path, help="folder of the plan")
    plan.add_argument(
        "--capture", type=Path, required=True, help="folder of the photos, which is moved there"
    )
    plan.add_argument("--options", required=True, help="TrainOptions with tiles, as JSON")
    unit = programs.add_parser("unit", help="do some units of a plan, or all that are left")
    unit.add_argument("folder", type=Path)
    unit.add_argument("names", nargs="*")
    unit.add_argument("--begun", type=int, help="descriptor for the names of the units that begin")
    units = programs.add_parser("units", help="list the units of a plan")
    units.add_argument("folder", type=Path)
    units.add_argument("--json", action="store_true", help="print one JSON document instead of lines")
    doctor = programs.add_parser("doctor", help="check whether Splatmill runs on this machine")
    doctor.add_argument("--json", action="store_true", help="print one JSON document instead of lines")
    bench = programs.add_parser(
        "bench", help="run worker/bench/NAME.py or server/bench/NAME.py (source tree only)"
    )
    bench.add_argument("name")
    bench.add_argument("arguments", nargs=argparse.REMAINDER)
    chosen = parser.parse_args(argv)
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPIN_COUNT)  # OpenMP reads it once, when torch is imported
    if chosen.program == "train":
        return_freed_memory()
        with uncollected():
            from splatmill_worker.service.command import serve

        return serve(chosen.stop_grace, chosen.queues)
    if chosen.program == "renderer":
        with uncollected():
            from splatmill_worker.render_service.command import serve as serve_renders

        return serve_renders(chosen.host, chosen.port, chosen.uds, chosen.fd, chosen.backend)
    if chosen.program in ("render-file", "orbit-file"):
        with uncollected():
            from splatmill_worker.render_service.local import main as local_main

        return local_main(chosen)
    if chosen.program == "convert-file":
        with uncollected():
            from splatmill_worker.render_service.convert import main as convert_main

        return convert_main(chosen.model, chosen.outs, chosen.photos)
    if chosen.program == "clean-file":
        with uncollected():
            from splatmill_worker.render_service.clean import run as clean_run

        return clean_run(chosen)
    if chosen.program == "mesh-file":
        with uncollected():
            from splatmill_worker.render_service.mesh import main as mesh_main

        return mesh_main(chosen)
    if chosen.program == "model-text":
        from splatmill_worker.sfm.posed.text import main as text_main

        return text_main(chosen.folder)
    if chosen.program == "fit-image":
        with uncollected():
            from splatmill_worker.fit_image.command import main as fit_image_main

        return fit_image_main(chosen.photo, chosen.out, chosen.options)
    if chosen.program in ("plan", "unit", "units"):
        return_freed_memory()
        with uncollected():
            from splatmill_worker.tiles import command

        if chosen.program == "plan":
            return command.make_plan(chosen.folder, chosen.capture, chosen.options)
        if chosen.program == "unit":
            return command.do_units(chosen.folder, chosen.names, chosen.begun)
        return command.list_units(chosen.folder, as_json=chosen.json)
    if chosen.program == "doctor":
        from splatmill_worker.doctor import report

        return report(as_json=chosen.json)
    return _bench(chosen.name, chosen.arguments)


def return_freed_memory() -> None:
    """Let glibc return freed memory to the system. There is no effect with another C library."""
    mmap_threshold, arena_max = -3, -8  # M_MMAP_THRESHOLD and M_ARENA_MAX of malloc.h
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None and sys.platform == "linux":
        mallopt(mmap_threshold, MMAP_THRESHOLD)
        mallopt(arena_max, 2)


def _bench(name: str, arguments: list[str]) -> int:
    parts = Path(__file__).resolve().parent.parent.parent
    folders = [parts / part / "bench" for part in ("worker", "server")]
    # A file, or a folder of several with the one of its name.
    places = (path for folder in folders for path in (folder / f"{name}.py", folder / name / f"{name}.py"))
    script = next((path for path in places if path.is_file()), None)
    if script is None:
        stems = [path.stem for folder in folders for path in folder.glob("*.py")]
        stems += [
            path.stem for folder in folders for path in folder.glob("*/*.py") if path.stem == path.parent.name
        ]
        known = sorted(stem for stem in stems if not stem.startswith("_"))
        print(
            f"There is no benchmark {name!r}. The benchmarks are {', '.join(known)}."
            if known
            else "The benchmarks are not part of the installed package. Run this in a source tree.",
            file=sys.stderr,
        )
        return 2
    sys.path[:0] = map(str, folders)
    spec = importlib.util.spec_from_file_location(f"bench_{name}", script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return int(module.main(arguments) or 0)


if __name__ == "__main__":
    sys.exit(main())
