"""The parts of `bench train`: what is run, how one row is measured, where rows are kept, and what is made of them."""
