"""What `splatmill bench gabor` alone uses: its pictures."""
