"""What `bench abuse` consists of: the owner who abuses the service, the one who trains, and the servers of both."""
