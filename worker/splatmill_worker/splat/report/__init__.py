"""What a finished training leaves: the model's files and the report of error against run time."""
