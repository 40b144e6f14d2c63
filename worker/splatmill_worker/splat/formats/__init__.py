"""The file formats of a model, one file each with `read` and `write`; `registry` finds the one of a path."""
