"""The rules of ARCHITECTURE.md that a machine can check: imports, file sizes, stems, and that imports stay cheap.

Does not prove that the design is good, only that the code still follows it.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from graphlib import TopologicalSorter
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

import pytest

from splatmill import schema

ROOT = Path(__file__).parent.parent
PARTS = {
    "splatmill": ROOT / "client" / "splatmill",
    "splatmill_server": ROOT / "server" / "splatmill_server",
    "splatmill_worker": ROOT / "worker" / "splatmill_worker",
}
OPS = ("project", "bin", "composite", "loss", "knn", "median_depth")
NOT_ON_GPU = ("correlate",)  # photos are compared before anything is on the device


def sources() -> list[Path]:
    folders = [*PARTS.values(), ROOT / "worker" / "bench", ROOT / "server" / "bench", ROOT / "tests"]
    return [p for f in folders for p in f.rglob("*") if p.suffix in {".py", ".cpp", ".hpp", ".html"}]


def test_import_rules_hold():
    lint = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([lint, "--no-cache"], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_import_of_the_web_page_goes_in_a_circle():
    """Types are imported in comments, which the browser does not load."""
    page = PARTS["splatmill_server"] / "web" / "page"
    imports = re.compile(r'^(?!\s*(?://|/?\*)).*?(?:\bfrom\s*|\bimport\s*\(?\s*)"(\.[^"]+)"', re.M)
    files = {path.resolve(): path.read_text() for path in page.rglob("*.js")}
    edges = {
        path: {(path.parent / name).resolve() for name in imports.findall(files[path])} for path in files
    }
    assert sum(map(len, edges.values())) > 100
    assert {to for targets in edges.values() for to in targets} <= files.keys()
    assert list(TopologicalSorter(edges).static_order())  # raises CycleError with the circle


def test_no_file_is_over_600_lines():
    long = {str(p.relative_to(ROOT)): n for p in sources() if (n := len(p.read_text().splitlines())) > 600}
    assert not long


MOST_FILES = 20
"""Files of a folder."""

FULLER = {
    "server/bench": 24,
    "server/splatmill_server/web/page": 21,
    "worker/bench": 41,
}
"""Folders with more files than that, and how many at most. No folder is added, and no number grows."""


def test_no_folder_has_over_20_files():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    counts = Counter(Path(line).parent.as_posix() for line in listed.splitlines())
    full = {folder: count for folder, count in counts.items() if count > MOST_FILES}
    assert not {folder: count for folder, count in full.items() if count > FULLER.get(folder, MOST_FILES)}
    assert full.keys() == FULLER.keys(), "a folder that has no more files than 20 leaves the list"


@pytest.mark.parametrize("backend", ["reference", "cpu", "gpu"])
def test_every_backend_has_the_same_stems(backend: str):
    folder = PARTS["splatmill_worker"] / "kernels" / backend
    stems = {p.stem for p in folder.rglob("*")}
    assert set(OPS) <= stems
    assert not set(NOT_ON_GPU) - stems if backend != "gpu" else not set(NOT_ON_GPU) & stems


@pytest.mark.parametrize(
    ("module", "forbidden"),
    [
        ("splatmill", {"torch", "numpy", "redis", "rq", "obstore", "fastapi"}),
        ("splatmill.schema", {"torch", "numpy", "redis", "rq", "obstore", "fastapi"}),
        ("splatmill_server.app", {"torch", "numpy", "pycolmap", "cv2", "splatmill_worker"}),
        # The queue worker forks an attempt; torch's and COLMAP's threads do not survive a fork.
        ("splatmill_worker.service.rq_worker", {"torch", "pycolmap", "cv2", "splatmill_server"}),
        # An attempt imports this before its first word; matplotlib would take a fifth of that time.
        ("splatmill_worker.pipeline", {"matplotlib", "triton"}),
        ("splatmill_worker", {"torch", "numpy", "pycolmap", "cv2", "redis", "pydantic"}),
        ("splatmill_worker.kernels", {"triton", "pycolmap", "cv2", "redis", "splatmill"}),
        # The processes that decode photos import this: each attempt starts some, which know neither Redis nor messages.
        (
            "splatmill_worker.images.video.video",
            {"torch", "pycolmap", "cv2", "redis", "rq", "obstore", "httpx", "pydantic"},
        ),
    ],
)
def test_importing_stays_cheap(module: str, forbidden: set[str]):
    code = f"import sys, {module}; print(*sorted(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    assert forbidden.isdisjoint(done.stdout.split())


def test_a_name_of_the_schema_is_one_thing_in_all_its_modules():
    """The package takes its names from its modules when the first is used, from whichever has them."""
    modules = [import_module(each.name) for each in walk_packages(schema.__path__, "splatmill.schema.")]
    exported = re.findall(r"\b(\w+) as \1\b", Path(schema.__file__).read_text())
    assert len(exported) > 200
    for name in exported:
        ids = {id(vars(module)[name]) for module in modules if name in vars(module)}
        assert ids == {id(getattr(schema, name))}, name
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = schema.no_such_name


def test_untrusted_files_are_opened_in_one_place():
    """`Image.open` and `av.open` for reading, and other decoders: pictures and videos come from strangers.

    Of OpenCV, one module offers what finds features.
    """
    guarded = PARTS["splatmill_worker"] / "images" / "guarded.py"
    opencv = PARTS["splatmill_worker"] / "opencv.py"
    decoders = {"cv2", "imageio", "skimage", "tifffile", "rawpy", "torchvision", "decord", "moviepy", "wand"}
    places = []
    for path in [
        *(p for part in PARTS.values() for p in part.rglob("*.py")),
        *(ROOT / "worker/bench").rglob("*.py"),
    ]:
        for node in ast.walk(ast.parse(path.read_text())):
            match node:
                case ast.Call(func=ast.Attribute(attr="open", value=ast.Name(id="Image"))) if path != guarded:
                    places.append(f"{path}:{node.lineno}")
                case ast.Call(func=ast.Attribute(attr="open", value=ast.Name(id="av"))) if path != guarded:
                    if [arg.value for arg in node.args[1:2] if isinstance(arg, ast.Constant)] != ["w"]:
                        places.append(f"{path}:{node.lineno}")
                case ast.ImportFrom(module="PIL.Image" | "av" | "av.container"):
                    places.append(f"{path}:{node.lineno}")
                case ast.Import() | ast.ImportFrom():
                    names = [getattr(node, "module", None) or "", *(alias.name for alias in node.names)]
                    if decoders & {name.partition(".")[0] for name in names} and path != opencv:
                        places.append(f"{path}:{node.lineno}")
    assert not places
    assert set(re.findall(r"cv2\.(\w+)", opencv.read_text())) == {"setNumThreads", "SIFT", "__version__"}


def test_the_server_and_the_client_open_no_pictures():
    for part in ("splatmill", "splatmill_server"):
        for path in PARTS[part].rglob("*.py"):
            assert not re.search(r"^\s*(from|import) (PIL|av|numpy)\b", path.read_text(), re.M), path


def test_header_fields_and_addresses_of_others_are_parsed_in_one_place_each():
    """Python's own parsers raise for some of them, each an error of its own."""
    parsers = {
        r"parsedate\w*|mktime_tz": {"client/splatmill/schema/headers.py"},
        r"urlsplit|urlparse|urlunsplit": {
            "client/splatmill/backplane/storage/storage.py",  # of the operator
            "server/splatmill_server/access/browsers.py",
        },
        r"httpx\.URL\(": {
            "client/splatmill/transfer/connection.py",  # of the user
            "server/splatmill_server/background/imports.py",  # after it was checked
            "server/splatmill_server/base/outgoing.py",
            "server/splatmill_server/base/settings.py",  # of the operator
        },
        r"(int|float)\([^()\n]*headers": set(),
        r"headers\b[^\n]*\.isdigit\(": set(),
    }
    for pattern, allowed in parsers.items():
        files = {
            path.relative_to(ROOT).as_posix()
            for part in ("splatmill", "splatmill_server")
            for path in PARTS[part].rglob("*.py")
            if re.search(pattern, path.read_text())
        }
        assert files == allowed, pattern


def test_keys_of_rq_are_named_in_one_place():
    named = {
        path.relative_to(ROOT).as_posix()
        for part in PARTS.values()
        for path in part.rglob("*.py")
        if re.search(r"\brq:|REDIS_WORKER_KEYS|WORKERS_BY_QUEUE_KEY", path.read_text())
    }
    assert named == {"client/splatmill/backplane/queue/rq_keys.py"}


def test_every_test_file_says_what_it_proves():
    mute = [
        str(p.relative_to(ROOT))
        for p in (ROOT / "tests").rglob("test_*.py")
        if '"""' not in p.read_text()[:8]
    ]
    assert not mute


def test_every_type_ignore_has_its_reason():
    bare = re.compile(r"# type: ignore(\[[a-z, -]+\])?\s*$", re.M)
    places = [str(p.relative_to(ROOT)) for p in sources() if p.suffix == ".py" and bare.search(p.read_text())]
    assert not places
