"""The group of all commands. The module of a command is imported when the command is run or its help is shown."""

from importlib import import_module
from typing import Annotated, Any

import typer
import typer.main
from typer.core import TyperGroup

from splatmill import __version__
from splatmill.cli.servers import with_profile

# The module and function of each command.
COMMANDS = {
    "train": ("splatmill.cli.commands.train", "train"),
    "plan": ("splatmill.cli.commands.tiles", "plan"),
    "unit": ("splatmill.cli.commands.tiles", "unit"),
    "units": ("splatmill.cli.commands.tiles", "units"),
    "fit-image": ("splatmill.cli.commands.fit_image", "fit_image"),
    "options": ("splatmill.cli.commands.jobs", "options"),
    "jobs": ("splatmill.cli.commands.jobs", "jobs"),
    "status": ("splatmill.cli.commands.jobs", "status"),
    "follow": ("splatmill.cli.commands.attach", "follow"),
    "logs": ("splatmill.cli.commands.attach", "logs"),
    "cancel": ("splatmill.cli.commands.jobs", "cancel"),
    "restart": ("splatmill.cli.commands.jobs", "restart"),
    "rename": ("splatmill.cli.commands.jobs", "rename"),
    "label": ("splatmill.cli.commands.jobs", "label"),
    "delete": ("splatmill.cli.commands.delete", "delete"),
    "bin": ("splatmill.cli.commands.bin", "bin_commands"),
    "models": ("splatmill.cli.commands.records", "models"),
    "download": ("splatmill.cli.commands.models.models", "download"),
    "shares": ("splatmill.cli.commands.models.shares", "shares"),
    "render": ("splatmill.cli.commands.models.pictures", "render"),
    "orbit": ("splatmill.cli.commands.models.pictures", "orbit"),
    "edit": ("splatmill.cli.commands.models.edit", "edit"),
    "clean": ("splatmill.cli.commands.models.clean", "clean"),
    "mesh": ("splatmill.cli.commands.models.mesh", "mesh"),
    "convert": ("splatmill.cli.commands.models.convert", "convert"),
    "cameras": ("splatmill.cli.commands.models.cameras", "cameras"),
    "captures": ("splatmill.cli.commands.records", "captures"),
    "import": ("splatmill.cli.commands.imports", "import_file"),
    "up": ("splatmill.cli.commands.service", "up"),
    "storage": ("splatmill.cli.commands.storage", "storage"),
    "keys": ("splatmill.cli.commands.keys", "keys"),
    "webhooks": ("splatmill.cli.commands.webhooks", "webhooks"),
    "doctor": ("splatmill.cli.commands.service", "doctor"),
    "bench": ("splatmill.cli.commands.service", "bench"),
}

# The commands under each heading of `splatmill --help`; those without one are under the last heading.
HEADINGS = {
    "Make a model": ("train", "plan", "unit", "units", "fit-image", "options"),
    "Jobs on a server": (
        "jobs",
        "status",
        "follow",
        "logs",
        "cancel",
        "restart",
        "rename",
        "label",
        "delete",
        "bin",
    ),
    "Models and captures": (
        "models",
        "download",
        "shares",
        "render",
        "orbit",
        "edit",
        "clean",
        "mesh",
        "convert",
        "cameras",
        "captures",
        "import",
    ),
    "The service and this machine": ("up", "keys", "webhooks", "storage", "doctor", "bench"),
}


def heading_of(name: str) -> str:
    """Return the heading of a command in `splatmill --help`."""
    return next((text for text, names in HEADINGS.items() if name in names), [*HEADINGS][-1])


# The arguments of these commands are parsed by the programs that they start.
PASS_ARGUMENTS_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


class Commands(TyperGroup):
    """A group that imports its commands on demand and prints their errors as sentences."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in COMMANDS:
            return None
        module, function = COMMANDS[cmd_name]
        entry = getattr(import_module(module), function)
        if isinstance(entry, typer.Typer):  # a group of commands
            for registered in entry.registered_commands:
                registered.callback = with_profile(registered.callback) if registered.callback else None
        else:
            single = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
            settings = PASS_ARGUMENTS_ON if cmd_name in ("up", "doctor", "bench") else None
            single.command(cmd_name, context_settings=settings)(with_profile(entry))
            entry = single
        command: Any = typer.main.get_command(entry)
        command.name, command.rich_help_panel = cmd_name, heading_of(cmd_name)
        return command

    def invoke(self, ctx: Any) -> Any:
        from splatmill.errors import SplatmillError

        try:
            return super().invoke(ctx)
        except (SplatmillError, OSError) as error:
            if isinstance(error, BrokenPipeError):
                raise  # in `splatmill jobs | head`, typer ends the process quietly
            from splatmill.cli.exits import print_error

            raise typer.Exit(print_error(error)) from error
        except KeyboardInterrupt:
            typer.echo("Stopped.", err=True)
            raise typer.Exit(130) from None


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(requested: bool) -> None:
    if requested:
        typer.echo(f"splatmill {__version__}")
        raise typer.Exit


@app.callback()
def splatmill(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Photos in, Gaussian splats out."""
