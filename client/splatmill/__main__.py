"""Runs the command line: `python -m splatmill`."""

from splatmill.cli import main

if __name__ == "__main__":
    main()
