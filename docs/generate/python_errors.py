"""The tree of the SDK's exceptions, from the docstring of `splatmill.errors`; included in the page on the SDK."""

import inspect

from splatmill import errors


def page() -> str:
    """The tree as a block of text."""
    tree = inspect.cleandoc(errors.__doc__ or "").partition("\n\n")[2]
    return f"```text\n{tree}\n```\n"
