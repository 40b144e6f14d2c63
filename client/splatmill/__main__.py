"""`python -m splatmill` is the command line."""

from splatmill.cli import main

if __name__ == "__main__":
    main()
