"""The command line `splatmill`."""


def main() -> None:
    """Run the command line with the process's arguments and exit with its code."""
    from splatmill.cli.app import app

    app()
