"""Proves whom the sockets of the service let in, and what takes the place of a socket.

Not proved here: the modes of what a running service stores (test_main), and the renderer's use of its socket
(tests/worker/render_service/test_command).
"""

import os
import socket
import stat
from pathlib import Path

import pytest

from splatmill.backplane import private_files

ADVICE = "choose another path."


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_socket_and_the_folders_made_for_it_are_for_its_user(tmp_path: Path) -> None:
    path = tmp_path / "new" / "inner" / "s.sock"
    before = os.umask(0o022)
    try:
        private_files.listen(path, ADVICE).close()
        (tmp_path / "after").touch()
    finally:
        os.umask(before)
    assert mode(path) == 0o600
    assert mode(path.parent) == 0o700
    assert mode(path.parent.parent) & 0o700 == 0o700, "its user cannot enter the folder"
    assert mode(tmp_path / "after") == 0o644, "the mask of the process has changed"


def test_the_socket_of_a_killed_process_is_replaced_and_one_in_use_is_not(tmp_path: Path) -> None:
    path = tmp_path / "s.sock"
    private_files.listen(path, ADVICE).close()  # which leaves the socket, as a kill does
    with private_files.listen(path, ADVICE) as listener:
        listener.listen()
        with pytest.raises(OSError, match=f"Another server listens on {path}; stop it, or {ADVICE}"):
            private_files.listen(path, ADVICE)
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(path))


def test_a_file_in_the_place_of_a_socket_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "photo.jpg"
    path.write_bytes(b"precious")
    folder = tmp_path / "folder"
    folder.mkdir()
    for place in (path, folder):
        with pytest.raises(OSError, match=f"{place} cannot be created: there is a file; .* or {ADVICE}"):
            private_files.listen(place, ADVICE)
    with pytest.raises(OSError, match=f"cannot be created: .* or {ADVICE}"):
        private_files.listen(path / "s.sock", ADVICE)
    assert path.read_bytes() == b"precious"
