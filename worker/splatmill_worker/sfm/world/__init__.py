"""The world of a reconstruction: its origin, its scale and where up is, from GPS or from how people hold cameras."""
