"""The worker: the engine, the queue worker and the renderer."""
