"""A job that cannot be done as asked, in words a person can act on."""

from __future__ import annotations

from typing import Any


class Refusal(Exception):
    """`code` is one of the wire's stable codes; `facts` are what was seen; `advice` says what to do."""

    def __init__(self, code: str, message: str, *, advice: str, facts: dict[str, Any] | None = None) -> None:
        super().__init__(f"{message} {advice}")
        self.code = code
        self.message = message
        self.advice = advice
        self.facts = facts or {}
