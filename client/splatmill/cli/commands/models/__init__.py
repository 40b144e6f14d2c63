"""The commands of models: their files, pictures, meshes, cameras, edits and links."""
