"""Colours of photos and videos as sRGB: by what their files name, or by what is assumed where they name nothing."""
