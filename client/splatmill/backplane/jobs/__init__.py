"""The record of a job: its row, its events, and the state that follows from them."""
