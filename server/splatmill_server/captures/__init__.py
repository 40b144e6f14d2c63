"""Captures: their records and files, uploads in parts, and imports from web addresses."""
