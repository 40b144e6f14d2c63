"""Meshes of models: depth from many cameras, fused into a signed distance field and written as triangles."""
