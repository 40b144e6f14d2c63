"""What several endpoints are asked with: their parameters, ids with the check of their owner, and forms."""
