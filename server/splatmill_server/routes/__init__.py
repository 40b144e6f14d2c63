"""The HTTP endpoints, with one router per resource. They parse requests and build responses."""
