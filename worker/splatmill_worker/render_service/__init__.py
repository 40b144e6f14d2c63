"""The renderer: an HTTP process that renders images and videos of stored models."""
