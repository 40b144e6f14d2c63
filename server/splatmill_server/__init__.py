"""The Splatmill REST API: `create_app(settings)` returns the app, `python -m splatmill_server` serves it."""
