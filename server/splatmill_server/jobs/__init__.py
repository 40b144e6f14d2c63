"""Jobs: their records, logs and places in the queue, and the reaper that repairs what workers cannot."""
