"""Servers, proxies and stand-ins around the service, its queue and its events."""
