"""Photos: which of the given files are usable, what zips and videos hold, and their pixels at the training size."""
