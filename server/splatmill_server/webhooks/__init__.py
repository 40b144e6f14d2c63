"""Webhooks: their records, and the deliveries of events."""
