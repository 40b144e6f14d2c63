"""Who sends a request. The middleware finds the caller; endpoints receive it as a parameter of the type `Who`."""

from dataclasses import dataclass, field
from typing import Annotated, cast

from fastapi import Depends, Request

from splatmill.schema import DEFAULT_OWNER, KeyLimits, Scope
from splatmill_server.access.keys import StoredKey

EVERYTHING = frozenset({Scope.admin})


@dataclass(frozen=True)
class Caller:
    """The sender of a request.

    owner: to whom the records belong that this caller makes.
    key_id: id of the stored key that was sent, or None.
    key_name: name of that key for people, or what was used in place of a stored key.
    scopes: what the caller may do.
    limits: how much the caller may do.
    by_session: whether a browser's session stands for the key.
    """

    owner: str
    key_id: str | None = None
    key_name: str = ""
    scopes: frozenset[Scope] = EVERYTHING
    limits: KeyLimits = field(default_factory=KeyLimits)
    by_session: bool = False

    @classmethod
    def of(cls, key: StoredKey) -> "Caller":
        """Return the caller that sends a stored key."""
        return cls(key.owner, key.id, key.name, frozenset(key.scopes), key.limits)

    @property
    def with_key(self) -> bool:
        """Whether the caller has shown a key, stored or that of the setting."""
        return self.key_id is not None or self == BOOTSTRAP

    def has(self, scope: Scope) -> bool:
        """Return whether the caller may do what `scope` permits."""
        return any(scope in held.permits for held in self.scopes)

    @property
    def admin(self) -> bool:
        """Whether the caller may do everything, with the records of all owners."""
        return Scope.admin in self.scopes

    def may_see(self, owner: str | None) -> bool:
        """Return whether the caller may know of a record; only an admin may if its owner is not known (None)."""
        return self.admin or (owner is not None and owner == self.owner)

    def listed_owner(self, asked: str | None) -> str | None:
        """Return the owner whose records a list holds, or None for those of all owners.

        asked: the owner that the request asks for. Only an admin has a choice; others get their own records.
        """
        return asked if self.admin else self.owner


KEYLESS = Caller(DEFAULT_OWNER, key_name="no key")
"""The caller of a server that has no keys."""

NOBODY = Caller("", key_name="", scopes=frozenset())
"""The caller of the paths that ask for no key."""

BOOTSTRAP = Caller(DEFAULT_OWNER, key_name="SPLATMILL_API_KEY")
"""The caller that sends the key of the setting SPLATMILL_API_KEY."""


async def _caller(request: Request) -> Caller:  # as a coroutine, it takes no thread of the pool
    return cast(Caller, request.state.caller)


Who = Annotated[Caller, Depends(_caller)]
"""The parameter through which an endpoint receives its caller."""
