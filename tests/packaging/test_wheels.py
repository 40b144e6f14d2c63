"""The wheels of the three parts stand alone: installed without the source tree, the client's talks to servers with few
libraries, and all three train the built-in scene from the command line.

Does not prove that the newest versions of the dependencies work (constraints.txt names those that were tried), nor
anything about wheels of other processors and systems. The worker's wheel takes what is compiled from worker/build, as
`make install` does; CMake compiles again what has changed since.
"""

from __future__ import annotations

import os
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from splatmill.cli.local.programs import ALL_PARTS
from tests.support.wheels import PARTS, ROOT, Built, build, environment, metadata, run, watch

pytestmark = pytest.mark.slow

FOREIGN = ("torch", "numpy", "redis", "rq", "obstore", "fastapi", "splatmill_server", "splatmill_worker")
MODULES = ("splatmill", "splatmill_server", "splatmill_worker")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Built]:
    """The wheel and the source distribution of each part, by its folder."""
    folder = tmp_path_factory.mktemp("wheels")
    # setuptools keeps modules that are gone in its build folder, so these two are built from their sdists.
    return {
        "client": build(ROOT / "client", folder / "client"),
        "server": build(ROOT / "server", folder / "server"),
        "worker": build(ROOT / "worker", folder / "worker", "--sdist", "--wheel"),
    }


@pytest.fixture(scope="module")
def wheels(built: dict[str, Built]) -> dict[str, Path]:
    """The wheel of each part, by its folder."""
    return {folder: part.wheel for folder, part in built.items()}


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory, wheels: dict[str, Path]) -> Path:
    """The `bin` folder of an environment with the client's wheel."""
    return environment(tmp_path_factory.mktemp("alone"), wheels["client"])


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, wheels: dict[str, Path]) -> Path:
    """The `bin` folder of an environment with all three wheels, as the command line says to install them."""
    assert ALL_PARTS == "pip install splatmill 'splatmill-server[embedded]' splatmill-worker"
    return environment(tmp_path_factory.mktemp("whole"), *wheels.values(), server="embedded")


def bare(**more: str) -> dict[str, str]:
    """This process's variables without those that name other code or another service."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "SPLATMILL", "REDIS", "COV"))}
    return kept | more


def test_the_wheels_have_one_version_and_their_licence(wheels: dict[str, Path]) -> None:
    client = metadata(wheels["client"])
    text = (ROOT / "LICENSE").read_text()
    for name, folder in PARTS.items():
        package = metadata(wheels[folder])
        assert package.metadata["Name"] == name
        assert package.version == client.version
        assert package.read_text("licenses/LICENSE") == text
        assert str(package.metadata["Description"]).startswith(f"# {name}\n")


def test_the_server_contains_its_web_page_and_the_licences_of_others(wheels: dict[str, Path]) -> None:
    with zipfile.ZipFile(wheels["server"]) as archive:
        names = set(archive.namelist())
    web = ROOT / "server" / "splatmill_server" / "web"
    ours = {f"splatmill_server/web/{path.relative_to(web)}" for path in (web / "page").rglob("*.*")}
    assert ours <= names
    assert "splatmill_server/web/vendor/imports.json" in names, "`make install` has fetched it"
    folders = {
        name.split("/")[3]
        for name in names
        if name.startswith("splatmill_server/web/vendor/") and "." in name
    }
    for folder in folders - {"imports.json"}:
        assert f"splatmill_server/web/vendor/{folder}/LICENSE" in names
    assert "playcanvas" in folders


def test_the_client_imports_without_the_other_parts_and_their_libraries(alone: Path) -> None:
    code = f"""
import importlib.util, sys
assert not [name for name in {FOREIGN} if importlib.util.find_spec(name)], "the environment is not a bare one"
import splatmill
assert "pydantic" not in sys.modules, "import splatmill must cost nothing"
import splatmill.schema, splatmill.sdk.client, splatmill.sdk.aio, splatmill.cli.app, splatmill.cli.commands.train
for name in splatmill.__all__:
    getattr(splatmill, name)
assert not [name for name in {FOREIGN} if name in sys.modules]
print(splatmill.__file__)
"""
    done = run(alone / "python", "-W", "error", "-I", "-c", code)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).is_relative_to(alone.parent)


def test_the_clients_command_line_runs(alone: Path, wheels: dict[str, Path]) -> None:
    version = metadata(wheels["client"]).version
    assert run(alone / "splatmill", "--version").stdout == f"splatmill {version}\n"
    options = run(alone / "splatmill", "options")
    assert "--time-budget" in options.stdout
    code = """
from typer.testing import CliRunner
from splatmill.cli.app import COMMANDS, app
for command in set(COMMANDS) - {"up", "doctor", "bench"}:  # which pass --help on to the other parts
    done = CliRunner().invoke(app, [command, "--help"])
    assert done.exit_code == 0, done.output
"""
    done = run(alone / "python", "-I", "-c", code)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", ["up", "doctor", "bench", "train"])
def test_a_missing_part_is_a_sentence_with_the_command_that_installs_it(
    alone: Path, command: str, tmp_path: Path
) -> None:
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        (tmp_path / name).write_bytes(b"x")
    arguments: list[str | Path] = [tmp_path, "-o", tmp_path / "out"] if command == "train" else []
    done = run(alone / "splatmill", command, *arguments)
    assert done.returncode == 8
    assert "is not installed" in done.stderr
    assert ALL_PARTS in done.stderr
    assert "Traceback" not in done.stderr


def test_the_types_are_shipped(whole: Path) -> None:
    (packages,) = whole.parent.glob("lib/python*/site-packages")
    assert all((packages / module / "py.typed").is_file() for module in MODULES)


def test_the_three_wheels_train_a_scene_from_the_command_line(whole: Path, tmp_path: Path) -> None:
    log = tmp_path / "log"
    watch(whole, log)
    environment = bare(PATH=str(whole))  # no program of the machine: the wheels bring their Redis

    modules = f"import {', '.join(MODULES)}; print(*(m.__file__ for m in ({', '.join(MODULES)})))"
    files = run(whole / "python", "-c", modules, cwd=tmp_path, env=environment).stdout.split()
    assert len(files) == 3
    assert all(Path(file).is_relative_to(whole.parent) for file in files)

    photos = ("photos", "--count", "16", "--width", "192", "--height", "144", "--samples", "1")
    done = run(whole / "python", "-m", "splatmill_worker.synthetic", *photos, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    done = run(
        *(whole / "splatmill", "train", "photos", "-o", "out", "--steps", "30", "--image-size", "120"),
        cwd=tmp_path,
        env=environment,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    model = (tmp_path / "out" / "model.ply").read_bytes()
    assert model.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert len(model) > 5000
    assert (tmp_path / "out" / "report.html").is_file()

    lines = log.read_text().splitlines()
    # Every process writes to the log: the command, the service that it starts, and the service's worker.
    for process in ("bin/splatmill train", "splatmill_server.up", "splatmill_worker train"):
        assert any(line.startswith("began") and process in line for line in lines), lines
    assert not [line for line in lines if line.startswith("opened")]


@pytest.mark.parametrize("folder", PARTS.values())
def test_a_source_distribution_holds_what_its_build_reads(
    folder: str, built: dict[str, Built], tmp_path: Path
) -> None:
    """Its own folder is enough: the version, which a checkout reads from the client, comes from PKG-INFO."""
    sdist = built[folder].sdist
    with tarfile.open(sdist) as archive:
        if hasattr(tarfile, "data_filter"):  # since 3.11.4; later ones warn where no filter is named
            archive.extraction_filter = tarfile.data_filter
        archive.extractall(tmp_path / "unpacked")
    (source,) = (tmp_path / "unpacked").iterdir()
    assert {"README.md", "LICENSE", "PKG-INFO", "pyproject.toml"} <= {path.name for path in source.iterdir()}
    version = metadata(built[folder].wheel).version
    if folder == "worker":  # the wheels of the other two come from their sdists
        suffixes = {".py", ".cpp", ".hpp"}
        kept = {str(p.relative_to(source)) for p in source.rglob("*") if p.suffix in suffixes}
        package = ROOT / "worker" / "splatmill_worker"
        ours = {str(p.relative_to(ROOT / "worker")) for p in package.rglob("*") if p.suffix in suffixes}
        assert ours | {"version.py"} <= kept
        assert not [name for name in kept if name.startswith(("bench", "sanitize", "build"))]
        read = "build.util.project_wheel_metadata(sys.argv[1], isolated=False)"
        done = run(sys.executable, "-c", f"import sys, build.util; print({read}['Version'])", source)
        assert done.returncode == 0, done.stderr
        version = done.stdout.split()[-1]
    assert sdist.name.removesuffix(".tar.gz").endswith(f"-{version}")
