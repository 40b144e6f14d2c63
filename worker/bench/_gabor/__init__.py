"""What `splatmill bench gabor` alone uses: its pictures, and its scene of a repeated texture."""
