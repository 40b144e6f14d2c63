"""Jobs: their records, logs, curves and places in the queue."""
