"""The Splatmill REST API: `create_app(settings)` makes it, `python -m splatmill_server` serves it."""
