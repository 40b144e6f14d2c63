"""The built wheel of the SDK stands alone: with its declared dependencies it imports and runs its command line, and
never asks for torch, numpy, redis or fastapi.

Does not prove that the newest versions of the dependencies work; constraints.txt names those that were tried.
"""

import subprocess
import sys
import venv
from importlib.metadata import Distribution, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

CLIENT = Path(__file__).parents[2] / "client"
FOREIGN = ("torch", "numpy", "redis", "rq", "obstore", "fastapi", "splatmill_server", "splatmill_worker")


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=120)


def closure(name: str, seen: dict[str, Distribution]) -> dict[str, Distribution]:
    """The distributions that `name` needs, itself left out, as they are installed here."""
    for text in distribution(name).requires or []:
        requirement = Requirement(text)
        wanted = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if wanted and requirement.name.lower() not in seen:
            seen[requirement.name.lower()] = distribution(requirement.name)
            closure(requirement.name, seen)
    return seen


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The `bin` folder of an environment that holds the wheel and its dependencies."""
    folder = tmp_path_factory.mktemp("wheel")
    # Built from a copy, so that no build folder appears in the working tree.
    source = folder / "client"
    source.mkdir()
    for entry in CLIENT.rglob("*"):
        inside = entry.relative_to(CLIENT)
        if entry.is_file() and inside.parts[0] in ("splatmill", "pyproject.toml") and entry.suffix != ".pyc":
            (source / inside).parent.mkdir(parents=True, exist_ok=True)
            (source / inside).write_bytes(entry.read_bytes())
    built = run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, source)
    assert built.returncode == 0, built.stdout + built.stderr
    (wheel,) = folder.glob("*.whl")

    place = folder / "venv"
    venv.create(place, with_pip=False, symlinks=True)
    (packages,) = place.glob("lib/python*/site-packages")
    for needed in closure("splatmill", {}).values():
        for top in {
            file.parts[0] for file in needed.files or [] if not file.parts[0].startswith(("..", "__"))
        }:
            target = Path(str(needed.locate_file(top)))
            if target.exists() and not (packages / top).exists():
                (packages / top).symlink_to(target)
    python = place / "bin" / "python"
    installed = run(
        sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", "-q", wheel
    )
    assert installed.returncode == 0, installed.stderr
    return place / "bin"


def test_it_imports_without_the_other_parts_and_their_libraries(alone: Path):
    code = f"""
import importlib.util, sys
assert not [name for name in {FOREIGN} if importlib.util.find_spec(name)], "the environment is not a bare one"
import splatmill
assert "pydantic" not in sys.modules, "import splatmill must cost nothing"
import splatmill.schema, splatmill.client, splatmill.aio, splatmill.cli.app, splatmill.cli.train
for name in splatmill.__all__:
    getattr(splatmill, name)
assert not [name for name in {FOREIGN} if name in sys.modules]
print(splatmill.__file__)
"""
    done = run(alone / "python", "-W", "error", "-I", "-c", code)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).is_relative_to(alone.parent)


def test_its_command_line_runs(alone: Path):
    assert run(alone / "splatmill", "--version").stdout.startswith("splatmill 0.")
    options = run(alone / "splatmill", "options")
    assert "--time-budget" in options.stdout
    for command in ("train", "render", "orbit", "jobs", "status", "cancel", "download"):
        assert run(alone / "splatmill", command, "--help").returncode == 0


@pytest.mark.parametrize("command", ["up", "doctor", "bench", "train"])
def test_a_missing_part_is_a_sentence_with_the_command_that_installs_it(
    alone: Path, command: str, tmp_path: Path
):
    (tmp_path / "a.jpg").write_bytes(b"x")
    arguments: list[str | Path] = [tmp_path, "-o", tmp_path / "out"] if command == "train" else []
    done = run(alone / "splatmill", command, *arguments)
    assert done.returncode == 8
    assert "is not installed" in done.stderr
    assert "pip install splatmill splatmill-server" in done.stderr
    assert "Traceback" not in done.stderr


def test_the_types_are_shipped(alone: Path):
    (packages,) = alone.parent.glob("lib/python*/site-packages")
    assert (packages / "splatmill" / "py.typed").is_file()
