"""Storage in a folder or a bucket: its layout, its files, and the format of the records in it."""
