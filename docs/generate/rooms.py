"""The map of the modules, from their sources, and the rooms of ARCHITECTURE.md, from the import contracts."""

import ast
import re
import tomllib
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from docs.generate.markdown import choices, code, table

ROOT = Path(__file__).resolve().parents[2]

PARTS = {
    "splatmill": ROOT / "client" / "splatmill",
    "splatmill_server": ROOT / "server" / "splatmill_server",
    "splatmill_worker": ROOT / "worker" / "splatmill_worker",
}

INTRODUCTION = """# The modules

What each module is for, as its own first sentence says, and its public functions and classes; made by `make generated`
from the program.
[ARCHITECTURE.md](ARCHITECTURE.md) has the rooms on one page, and how they work together. Rooms of server and worker are
in the order of their floors, from the top; other modules in that of the alphabet.
"""

_BLOCK = re.compile(r"(<!-- made by `make generated` from the program: (\w+) -->\n).*?(<!-- end -->)", re.S)


def modules() -> str:
    """The page of all modules."""
    parts = [
        f"## {folder.relative_to(ROOT)}\n\n" + "\n".join(_listed(name, folder, 0)) + "\n"
        for name, folder in PARTS.items()
    ]
    return "\n".join([INTRODUCTION, *parts])


def architecture() -> str:
    """The page ARCHITECTURE.md, with its blocks as the contracts and the first sentences are now."""
    blocks = {
        "contracts": _contracts(),
        "server": _rooms("splatmill_server"),
        "worker": _rooms("splatmill_worker"),
        "splat": _rooms("splatmill_worker.splat"),
    }
    return _BLOCK.sub(
        lambda match: match[1] + blocks[match[2]] + match[3], (ROOT / "ARCHITECTURE.md").read_text()
    )


def _contracts() -> str:
    """Who must not import what."""
    rows = []
    for contract in _read_contracts():
        match contract["type"]:
            case "forbidden":
                rows.append([choices(contract["source_modules"]), choices(contract["forbidden_modules"])])
            case "protected":
                others = f"all but {choices(contract['allowed_importers'])}"
                rows.append([others, choices(contract["protected_modules"])])
            case "independence":
                rows.append([choices(contract["modules"]), "each other"])
    return table(["module", "does not import"], rows)


def _rooms(package: str) -> str:
    """The rooms of a package, from the top floor."""
    floors = _floors(package)
    rows = [
        [str(len(floors) - number), _shown(path), _sentence(path)]
        for number, floor in enumerate(floors)
        for path in (_path_of(f"{package}.{room}") for room in floor)
    ]
    return table(["floor", "room", "holds"], rows)


def _listed(package: str, folder: Path, depth: int) -> Iterator[str]:
    """The modules of a package as a list, with those of its packages below them."""
    order = [room for floor in _floors(package) for room in floor]
    paths = [path for path in sorted(folder.iterdir()) if _is_module(path)]
    paths.sort(key=lambda path: order.index(path.stem) if path.stem in order else len(order))
    for path in paths:
        names = _names(path)
        yield f"{'  ' * depth}- {_shown(path)}: {_sentence(path)}{f' ({choices(names)})' if names else ''}"
        if path.is_dir():
            yield from _listed(f"{package}.{path.stem}", path, depth + 1)


def _is_module(path: Path) -> bool:
    return (path / "__init__.py").is_file() or (path.suffix == ".py" and path.stem != "__init__")


def _path_of(module: str) -> Path:
    part, _, rest = module.partition(".")
    path = PARTS[part].joinpath(*rest.split("."))
    return path if path.is_dir() else path.with_suffix(".py")


def _shown(path: Path) -> str:
    return code(f"{path.name}/" if path.is_dir() else path.name)


def _sentence(path: Path) -> str:
    """The first sentence of a module, or of a package."""
    source = path / "__init__.py" if path.is_dir() else path
    match = re.match(r'"""(.+?)(?:\n\n|""")', source.read_text(), re.S)
    if match is None:
        raise ValueError(f"{source} does not begin with a sentence that says what it is for.")
    return re.split(r"(?<=\.) (?=[A-Z`])", " ".join(match[1].split()), maxsplit=1)[0]


def _names(path: Path) -> list[str]:
    """The public functions and classes of a module, in their order; [] of a package."""
    if path.is_dir():
        return []
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    defined = [node.name for node in ast.parse(path.read_text()).body if isinstance(node, kinds)]
    return [name for name in dict.fromkeys(defined) if not name.startswith("_")]


def _floors(package: str) -> list[list[str]]:
    """The names of the rooms of a package floor by floor, from the top; [] if no contract names them."""
    for contract in _read_contracts():
        if contract["type"] == "layers" and package in contract["containers"]:
            return [re.split(r"\s*[|:]\s*", floor) for floor in contract["layers"]]
    return []


@cache
def _read_contracts() -> Sequence[dict[str, Any]]:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    contracts: Sequence[dict[str, Any]] = settings["tool"]["importlinter"]["contracts"]
    return contracts
