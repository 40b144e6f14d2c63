"""The queue worker: takes jobs from Redis, runs an attempt at each, stores what came out."""
