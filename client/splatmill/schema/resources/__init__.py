"""The resources of the API: their requests, their records as clients see them, and their events."""
