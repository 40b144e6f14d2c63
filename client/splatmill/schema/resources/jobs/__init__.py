"""Jobs: their requests and records, their events, and what is known of them before and while they run."""
