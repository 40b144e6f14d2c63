"""A scene in tiles: a coarse model of everything, tiles that are trained apart, and the model of all of them."""
