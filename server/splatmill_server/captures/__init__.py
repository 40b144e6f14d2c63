"""Captures: their records, files and uploads in parts."""
