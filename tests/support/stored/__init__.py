"""What earlier versions stored, and what makes it."""
