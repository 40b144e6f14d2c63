"""The job queue, built on RQ: its entries, the lines in which they wait, and the leases of those that run."""
