"""Folders that tests read."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BENCH = ROOT / "worker" / "bench"
DATA = ROOT.parent / "shared" / "data"
"""Real captures under licences of their own; a test that needs them skips where the folder is absent."""
