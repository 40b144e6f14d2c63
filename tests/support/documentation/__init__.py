"""The pages of the documentation as a reader follows them."""
