"""The web page as people and their devices meet it."""
