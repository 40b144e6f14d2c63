"""What passes between the host and the device: copies that nobody waits for, and the numbers that steps measured."""
