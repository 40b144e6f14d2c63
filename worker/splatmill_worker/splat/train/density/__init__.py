"""How the number of Gaussians follows the photos: by cloning, splitting and pruning."""
