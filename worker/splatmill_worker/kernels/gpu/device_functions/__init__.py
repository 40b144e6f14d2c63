"""The device functions that two passes share."""
