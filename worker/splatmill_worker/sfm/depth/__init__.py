"""Depth maps of posed photos: which belongs to which, in which unit they are, and the points that they show."""
