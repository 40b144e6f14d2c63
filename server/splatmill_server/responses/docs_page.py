"""The page at `/docs`: a table of the endpoints, from the OpenAPI document. It loads nothing and runs no script."""

from html import escape
from typing import Any

CONTENT_SECURITY_POLICY = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"

_STYLE = (
    "body{font:16px/1.5 sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}"
    "td{padding:.2rem 1rem .2rem 0;vertical-align:top}code{white-space:nowrap}"
)


def docs_page(document: dict[str, Any]) -> str:
    """Return the page for an OpenAPI document."""
    rows = "\n".join(
        f"<tr><td><code>{method.upper()}</code><td><code>{escape(path)}</code>"
        f"<td>{escape(str(operation.get('description') or operation.get('summary') or ''))}"
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    )
    title = f"{escape(document['info']['title'])} {escape(document['info']['version'])}"
    about = "".join(f"<p>{escape(part)}" for part in document["info"].get("description", "").split("\n\n"))
    return (
        f'<!doctype html>\n<html lang="en"><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>\n'
        f"<h1>{title}</h1>\n{about}\n"
        "<p>This page is an overview. Parameters, schemas and examples are in "
        '<a href="openapi.json">openapi.json</a>, which any OpenAPI viewer shows.\n'
        f"<table>\n{rows}\n</table>\n</html>\n"
    )
