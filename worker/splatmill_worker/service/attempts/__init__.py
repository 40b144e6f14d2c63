"""One attempt at a job in its process: photos are fetched, events sent, and the model is stored."""
