"""Meshes of models: depth from many cameras, a surface through the points that they agree on, and its triangles."""
