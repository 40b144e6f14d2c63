"""The command line `splatmill`."""


def main() -> None:
    """Run the command line on the arguments of the process, and exit with its status."""
    from splatmill.cli.app import app

    app()
