"""Requests that several endpoints share: their parameters, ids with the check of their owner, and forms."""
