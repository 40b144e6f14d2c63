"""What one API process or another does beside the requests, and what the renderer makes of models."""
