"""Addresses without their secrets, for messages and logs."""

import re

_USERINFO = re.compile(r"(?<=://).*@", re.DOTALL)
_SECRET = re.compile(r"(?i)([?&#;][^=&]*(?:pass|secret|token|key|credential|auth)[^=&]*=)[^&]*")


def redacted(url: str) -> str:
    """Return an address in which `***` stands for the password: `redis://user:***@host:6379/0`.

    The address need not be valid: everything before the last `@` counts as credentials, because a password may contain
    any character. A text that is neither an address nor a path may be a password, and becomes `***`.
    """
    if "://" not in url:
        return url if url.startswith(("/", "./", "../", "~", "file:")) else "***"
    return _SECRET.sub(r"\1***", _USERINFO.sub(_without_password, url))


def _without_password(address: "re.Match[str]") -> str:
    user, colon, _ = address[0].partition(":")
    # Without a colon, the only part may be a token.
    return f"{user}:***@" if colon and "@" not in user and "/" not in user else "***@"
