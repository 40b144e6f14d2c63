"""The HTTP endpoints, one router per noun. They read requests and write answers; the records do the work."""
