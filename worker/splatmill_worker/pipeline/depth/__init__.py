"""What depth maps beside the photos give to a training."""
