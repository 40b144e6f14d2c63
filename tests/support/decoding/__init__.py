"""Decoding processes as tests ask, watch and attack them."""
