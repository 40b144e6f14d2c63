"""`python -m splatmill_worker train | renderer | fit-image | doctor | bench NAME`."""

import argparse
import ctypes
import importlib.util
import os
import sys
from pathlib import Path

SPINS = "1000"
"""How often a thread looks before it sleeps at a barrier of the kernels. OpenMP's default spins for milliseconds,
which keeps the thread that is waited for off the core wherever cores are shared: beside other work on two cores a
training step took ten times as long. On a quiet machine this costs 2 %."""

OWN_PAGES = 8 * 2**20
"""Bytes from which an allocation has pages of its own, which go back when it is freed. glibc moves this limit up to
32 MiB by itself; the rows that densification copies then leave holes, and an attempt kept 200 MB more."""


def main(argv: list[str] | None = None) -> int:
    """Run one of the worker's programs; returns its exit status."""
    parser = argparse.ArgumentParser(prog="python -m splatmill_worker", description=__doc__)
    programs = parser.add_subparsers(dest="program", required=True)
    train = programs.add_parser(
        "train", help="take jobs from the queue (REDIS_URL, SPLATMILL_STORAGE, SPLATMILL_DATA)"
    )
    train.add_argument(
        "--stop-grace", type=float, help="seconds a job has to save its state when told to stop"
    )
    renderer = programs.add_parser("renderer", help="render stored models over HTTP")
    renderer.add_argument("--host", default="127.0.0.1")
    renderer.add_argument("--port", type=int, default=8090)
    renderer.add_argument("--uds", type=Path, help="listen on this unix socket instead of host and port")
    renderer.add_argument(
        "--backend", choices=["reference", "cpu", "gpu"], help="what computes (default: cpu)"
    )
    fit_image = programs.add_parser("fit-image", help="fit one picture by Gaussians in a plane")
    fit_image.add_argument("photo", type=Path)
    fit_image.add_argument("--out", type=Path, required=True, help="folder for the results")
    fit_image.add_argument("--options", default="{}", help="FitImageOptions as JSON")
    doctor = programs.add_parser("doctor", help="check this machine and say what to do")
    doctor.add_argument("--json", action="store_true", help="one JSON document instead of lines")
    bench = programs.add_parser("bench", help="run worker/bench/NAME.py (source tree only)")
    bench.add_argument("name")
    bench.add_argument("arguments", nargs=argparse.REMAINDER)
    chosen = parser.parse_args(argv)
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)  # read once, when torch is loaded
    if chosen.program == "train":
        give_memory_back()
        from splatmill_worker.service.command import serve

        return serve(chosen.stop_grace)
    if chosen.program == "renderer":
        from splatmill_worker.render_service.command import serve as serve_renders

        return serve_renders(chosen.host, chosen.port, chosen.uds, chosen.backend)
    if chosen.program == "fit-image":
        from splatmill_worker.fit_image.command import main as fit_image_main

        return fit_image_main(chosen.photo, chosen.out, chosen.options)
    if chosen.program == "doctor":
        from splatmill_worker.doctor import report

        return report(as_json=chosen.json)
    return _bench(chosen.name, chosen.arguments)


def give_memory_back() -> None:
    """Keep glibc from holding on to what was freed; other C libraries are left as they are."""
    mmap_threshold, arena_max = -3, -8  # malloc.h
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None and sys.platform == "linux":
        mallopt(mmap_threshold, OWN_PAGES)
        mallopt(arena_max, 2)


def _bench(name: str, arguments: list[str]) -> int:
    folder = Path(__file__).resolve().parent.parent / "bench"
    script = folder / f"{name}.py"
    if not script.is_file():
        known = sorted(path.stem for path in folder.glob("*.py") if not path.stem.startswith("_"))
        print(
            f"There is no benchmark {name!r}; there are {', '.join(known)}."
            if known
            else "Benchmarks are no part of the installed package: run this from a source tree.",
            file=sys.stderr,
        )
        return 2
    sys.path.insert(0, str(folder))
    spec = importlib.util.spec_from_file_location(f"bench_{name}", script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return int(module.main(arguments) or 0)


if __name__ == "__main__":
    sys.exit(main())
