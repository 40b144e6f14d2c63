"""What server and worker share behind the API: Redis keys and streams, the queue, and the storage layout.

Install it with the extra `splatmill[backplane]`. The SDK and the command line never import it.
"""
