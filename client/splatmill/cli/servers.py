"""The options --server and --profile, and the client they stand for."""

import functools
import inspect
import os
from collections.abc import Callable
from contextvars import ContextVar
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from splatmill.sdk.client import Client

ServerOption = Annotated[
    str | None,
    typer.Option(
        "--server",
        metavar="URL",
        envvar="SPLATMILL_SERVER",
        help="Address of the server. Left out, the server on this machine. The API key is read from "
        "SPLATMILL_API_KEY.",
    ),
]

_chosen: ContextVar[dict[str, Any] | None] = ContextVar("chosen", default=None)
"""While a command runs with a profile: the arguments of `Client` that choose its server."""


def _complete() -> list[str]:
    from splatmill.transfer.profiles import profile_names

    return profile_names()


_PROFILE = inspect.Parameter(
    "profile",
    inspect.Parameter.KEYWORD_ONLY,
    default=typer.Option(
        None,
        "--profile",
        metavar="NAME",
        help="Server of this name in config.toml, with its key and certificates, in place of --server. "
        "It may also be named by SPLATMILL_PROFILE.",
        show_default=False,
        autocompletion=_complete,
    ),
    annotation=str | None,
)


def with_profile(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return a command that takes --profile too, if it takes --server; `open_client` then opens that server."""
    signature = inspect.signature(command, eval_str=True)
    if "server" not in signature.parameters or "profile" in signature.parameters:
        return command

    @functools.wraps(command)
    def call(*, profile: str | None = None, **arguments: Any) -> Any:
        from splatmill.transfer.profiles import PROFILE_VARIABLE, read_profile

        server = arguments["server"]
        if profile is not None and server not in (None, os.environ.get("SPLATMILL_SERVER")):
            raise typer.BadParameter("Give --server or --profile, not both.", param_hint="--profile")
        name = profile or (os.environ.get(PROFILE_VARIABLE) if server is None else None)
        if name:
            arguments["server"] = read_profile(name).server
        # A profile of the environment is left to the client, which ranks it among the other variables.
        token = _chosen.set(({"profile": profile} if profile else {}) if name else None)
        try:
            return command(**arguments)
        finally:
            _chosen.reset(token)

    # typer reads the parameters from the signature.
    call.__signature__ = signature.replace(  # type: ignore[attr-defined]  # functions have no declared __signature__
        parameters=[*signature.parameters.values(), _PROFILE]
    )
    return call


def open_client(server: str | None) -> "Client":
    """Return a client of the profile that was chosen, else of `server`, else of the server on this machine."""
    from splatmill.sdk.client import Client

    chosen = _chosen.get()
    try:
        return Client(**chosen) if chosen is not None else Client(server or None)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--server") from error
