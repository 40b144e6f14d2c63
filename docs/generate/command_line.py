"""The command line, from typer; what `up`, `doctor` and `bench` take is asked of the programs behind them."""

import os
import subprocess
import sys
from itertools import groupby
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from docs.generate.markdown import code, table
from typer.main import get_command

from splatmill.cli.app import COMMANDS, HEADINGS, app, heading_of
from splatmill.cli.exits import Exit

INTRODUCTION = """# Command line

Every command of `splatmill`, generated from the program. Commands that talk to a server take `--server URL`, or read
the address from `SPLATMILL_SERVER`, and use the server on this machine when neither is given. The API key is read from
`SPLATMILL_API_KEY` alone, so that it does not appear in the list of processes. `--profile NAME` stands for a server
with its key, as [the SDK](../programming/sdk.md#servers-by-name) describes.

`splatmill --install-completion` sets up completion in bash, zsh, fish and PowerShell: of commands, options, and the
values of options that have a fixed set of them.

`splatmill COMMAND --help` prints the same for one command.
"""

EXIT_STATUS = """## Exit status

A script can tell how a command ended:
"""

MEANINGS = {
    Exit.done: "The command did what was asked.",
    Exit.error: "The service made a mistake, or a file could not be read or written.",
    Exit.usage: "An argument or option is wrong.",
    Exit.job_failed: "The job failed; the message has the problem's sentence, facts and advice.",
    Exit.unreachable: "No server answers, or a part of it is down or full; a later try may succeed.",
    Exit.refused: "The photos or the request cannot be used as they are.",
    Exit.unauthorized: "The API key is missing or wrong, or does not permit the request.",
    Exit.not_found: "There is no such job, model or file, or it is in a state that does not allow the request.",
    Exit.no_service: "The service on this machine could not be started.",
    Exit.cancelled: "The command was stopped by Ctrl-C or SIGTERM, or the job was cancelled by another client.",
}


def page() -> str:
    """The page of commands."""
    group = get_command(app)
    parts = [INTRODUCTION]
    commands = {name: group.get_command(None, name) for name in COMMANDS}  # type: ignore[attr-defined]  # a group, as app is
    for heading in HEADINGS:
        parts.append(f"## {heading}\n")
        for name, command in commands.items():
            if heading_of(name) == heading:
                members = getattr(command, "commands", None)  # a group of commands, such as `keys`
                parts += (
                    [_command(f"{name} {sub}", member) for sub, member in members.items()]
                    if members
                    else [_command(name, command)]
                )
    rows = [[str(int(status)), MEANINGS[status]] for status in Exit]
    return "\n".join([*parts, EXIT_STATUS, table(["status", "meaning"], rows)])


def _command(name: str, command: Any) -> str:
    if command.context_settings.get("ignore_unknown_options"):
        return f"### splatmill {name}\n\n```text\n{_said_by_program(name)}\n```\n"
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option" and "--help" not in p.opts]
    usage = " ".join([f"splatmill {name}", *map(_place, arguments), "[OPTIONS]"])
    parts = [f"### splatmill {name}\n", f"{command.help}\n", f"```text\n{usage}\n```\n"]
    if arguments:
        parts.append(table(["argument", "meaning"], [[code(_name(p)), p.help] for p in arguments]))
    for panel, members in groupby(options, key=lambda p: p.rich_help_panel):
        parts += [f"{panel}:\n"] if panel else []
        parts.append(table(["option", "meaning"], [[_spelling(p), _meaning(p)] for p in members]))
    return "\n".join(parts)


def _place(argument: Any) -> str:
    name = _name(argument) + ("..." if argument.nargs == -1 else "")
    return name if argument.required else f"[{name}]"


def _name(argument: Any) -> str:
    return str(argument.metavar or argument.name.upper())


def _spelling(option: Any) -> str:
    flags = ", ".join(code(flag) for flag in option.opts)
    return flags if option.is_flag else f"{flags} {code(_value(option))}"


def _value(option: Any) -> str:
    if option.metavar:
        return str(option.metavar)
    if values := _choices(option):
        return "|".join(values)
    kinds = {int: "INTEGER", float: "NUMBER", Path: "PATH"}
    return kinds.get(option.type_descriptor.annotation, "TEXT")


def _choices(option: Any) -> tuple[str, ...]:
    annotation = option.type_descriptor.annotation
    return get_args(annotation) if get_origin(annotation) is Literal else ()


def _meaning(option: Any) -> str:
    parts = [option.help]
    if option.min is not None and option.max is not None:
        parts.append(f"{option.min:,} to {option.max:,}.")
    if option.default is not None and not option.is_flag and option.show_default:
        parts.append(f"Default: {code(option.default)}.")
    if option.envvar:
        parts.append(f"Environment variable: {code(option.envvar)}.")
    return " ".join(parts)


def _said_by_program(name: str) -> str:
    """What `splatmill NAME --help` prints, eighty columns wide."""
    environment = os.environ | {"COLUMNS": "80"}
    command = [sys.executable, "-m", "splatmill", name, "--help"]
    said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    return said.replace("python -m splatmill_worker", "splatmill").strip()
