"""What training starts from: points, fillings of the gaps between them, a far shell, or a given model."""
