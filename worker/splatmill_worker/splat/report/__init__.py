"""The files of a finished training: the model, its cameras, the report and the progress video."""
