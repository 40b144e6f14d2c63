"""What other users of the machine may read of the service's files: nothing, unless the operator says otherwise.

Photos, models, and the secrets of webhooks lie in the data folder. A process of the service makes folders with the mode
0700 and files with 0600. Where its parts run as several users of one group, SPLATMILL_UMASK=027 (or 007, where they
write to the same folder) lets the group in.
"""

import errno
import os
import re
import shlex
import socket
import stat
from pathlib import Path

PRIVATE = 0o077
"""The mask that keeps out the group and all others."""

_MASK = re.compile(r"0?0[0-7]{2}", re.ASCII)


def parse_mask(text: str) -> int:
    """Return the mask in a text such as `027`. Raises ValueError for any other, or one against the user itself."""
    if not _MASK.fullmatch(text):
        raise ValueError(
            f"{text[:20]!r} is not a mask; write 077 (nobody else), 027 (the group may read), 007 (and write) or 022 "
            "(everybody may read)"
        )
    return int(text, 8)


def exposure(folder: Path, mask: int) -> str | None:
    """Return the sentence about a folder that lets others in whom `mask` keeps out; None for another folder."""
    try:
        mode = folder.stat().st_mode & 0o777
        reached = all(above.stat().st_mode & mask & 0o011 for above in folder.parents)
    except OSError:
        return None
    if not (mode & mask and reached):
        return None
    return (
        f"The folder {folder} has the mode {mode:04o}: other users of this machine may read photos and models in it. "
        f"Close it with: chmod {mode & ~mask:04o} {shlex.quote(str(folder))} . If they are meant to, set "
        "SPLATMILL_UMASK, such as 027 for the group."
    )


def close(folder: Path | None, mask: int) -> None:
    """Take away the rights to a folder with secrets that a copy or a restored backup gave, and that `mask` does not."""
    if folder is None or not folder.is_dir():
        return
    status = folder.stat()
    if status.st_uid == os.geteuid() and status.st_mode & mask:
        folder.chmod(stat.S_IMODE(status.st_mode) & ~mask)


def listen(path: Path, advice: str) -> socket.socket:
    """Return a socket at `path` that only this user can connect to, in place of one that a killed process left.

    Raises OSError, with a sentence that ends in `advice`, if another process listens there, or if the socket cannot be
    created. A file that is not a socket is kept.
    """
    if _is_answered(path):
        raise OSError(f"Another server listens on {path}; stop it, or {advice}")
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        if path.is_socket():
            path.unlink()
        before = os.umask(0o177)  # a chmod after `bind` would leave the socket open to others for a moment
        try:
            listener.bind(str(path))
        finally:
            os.umask(before)
    except OSError as error:
        listener.close()
        reason = "there is a file" if error.errno == errno.EADDRINUSE else error.strerror or error
        raise OSError(
            f"The socket {path} cannot be created: {reason}; free that path, or {advice}"
        ) from error
    return listener


def _is_answered(path: Path) -> bool:
    """Return whether a process listens on the socket at `path`."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return False
    return True
