"""The endpoints of models and of what is made of them."""
