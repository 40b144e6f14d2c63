"""The files of captures and models: their names, their kinds and their formats."""
