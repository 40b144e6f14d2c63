"""What never moves in the photos of one camera, such as a logo: it is found and hidden."""
