"""Who may do what: keys, sessions of browsers, the caller of a request, its permission and its rate."""
