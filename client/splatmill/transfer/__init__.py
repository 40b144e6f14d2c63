"""What a client sends and receives: its connection to a server, uploads, downloads and streams of events."""
