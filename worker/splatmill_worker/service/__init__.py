"""The queue worker: takes jobs from Redis, runs each attempt in a process of its own, and stores the models."""
