"""Responses that several endpoints share: files in ranges, event streams, rendered pictures, pages of the web."""
