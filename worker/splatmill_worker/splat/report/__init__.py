"""The files of a finished training: the model, its cameras and the report."""
