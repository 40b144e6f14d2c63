"""What commands do on this machine: the embedded service, its data folder, and model files."""
