"""Readers of strangers' points and COLMAP models, in processes of their own, and the memory that reading may take."""
