"""Engines: a scene under optimisation on one backend, behind one protocol."""
