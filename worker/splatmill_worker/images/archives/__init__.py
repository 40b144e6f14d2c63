"""Unpacks zips, and counts what that takes."""
