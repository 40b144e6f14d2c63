"""What the server and the worker share behind the API: Redis keys and streams, the job queue, and the storage layout.

It is installed with the extra `splatmill[backplane]`. The SDK and the command line never import it.
"""
