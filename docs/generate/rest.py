"""The REST API, from the server's own OpenAPI document."""

import json
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from docs.generate.markdown import choices, code, table

from splatmill_server.app import create_app
from splatmill_server.base.settings import Settings

INTRODUCTION = """# REST reference

Every address of the server, generated from its OpenAPI document. A running server has that document at
`/openapi.json`, and an overview as a web page at `/docs`. [The REST API](../programming/rest.md) explains how the
addresses work together.

Answers marked with a code are [problem documents](errors.md). Besides the codes listed, every address can answer with
`internal_error`, and `/v1/` addresses with `unauthorized`, `forbidden` and `too_many_requests` when the server asks for
an API key.
"""

HEADINGS = {
    "captures": "Captures",
    "jobs": "Jobs",
    "models": "Models",
    "shares": "Links to models",
    "webhooks": "Webhooks",
    "keys": "Keys",
    "service": "The service itself",
}
METHODS = ("post", "get", "head", "put", "patch", "delete")
EVERYWHERE = ("unauthorized", "forbidden", "invalid_request", "too_many_requests", "queue_unavailable")

Json = Mapping[str, Any]


def page() -> str:
    """The page of addresses and schemas."""
    document = openapi()
    operations = [
        (method, path, operation)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
        if method in METHODS
    ]
    parts = [INTRODUCTION]
    for tag, heading in HEADINGS.items():
        parts.append(f"## {heading}\n")
        parts += [
            _operation(document, method, path, operation)
            for method, path, operation in operations
            if operation["tags"] == [tag]
        ]
    parts.append("## Schemas\n")
    schemas = document["components"]["schemas"]
    parts += [_schema(name, schemas[name]) for name in sorted(schemas)]
    return "\n".join(parts)


def openapi() -> Json:
    """The OpenAPI document of a server with the default settings."""
    with tempfile.TemporaryDirectory() as folder:
        return create_app(Settings(data=Path(folder), storage="", api_key=None)).openapi()


def _operation(document: Json, method: str, path: str, operation: Json) -> str:
    parts = [f"### {method.upper()} {path}\n", f"{operation['description']}\n"]
    if parameters := operation.get("parameters"):
        rows = [
            [code(p["name"]), p["in"], _type(p["schema"]), _required(p) + p.get("description", "")]
            for p in parameters
        ]
        parts.append(table(["parameter", "in", "type", "meaning"], rows))
    if body := operation.get("requestBody"):
        parts += _body(body)
    parts.append(table(["answer", "meaning"], _answers(operation["responses"])))
    return "\n".join(parts)


def _required(parameter: Json) -> str:
    return "Required. " if parameter.get("required") and parameter["in"] != "path" else ""


def _body(body: Json) -> Iterator[str]:
    if "description" in body:
        yield f"Body: {body['description']}\n"
        return
    for media_type, content in body["content"].items():
        schema = content["schema"]
        yield f"Body, {code(media_type)}: {_type(schema)}\n"
        if "properties" in schema:
            yield _fields(schema)
        examples = [example["value"] for example in content.get("examples", {}).values()]
        for example in [*examples, *schema.get("examples", ())]:
            yield f"```json\n{json.dumps(example, indent=2)}\n```\n"


def _answers(responses: Json) -> Iterator[list[str]]:
    for status, answer in sorted(responses.items()):
        if int(status) < 400 or "application/problem+json" not in answer.get("content", {}):
            yield [status, _success(answer)]
            continue
        listed = answer["content"]["application/problem+json"].get("examples", {})
        own = [name for name in listed if name not in EVERYWHERE]
        if own:
            yield [status, choices(own)]


def _success(answer: Json) -> str:
    kinds = [
        _type(content["schema"])
        if media_type == "application/json" and "schema" in content
        else code(media_type)
        for media_type, content in answer.get("content", {}).items()
    ]
    said = answer["description"]
    return ": ".join(
        text for text in ("" if said == "Successful Response" else said, ", ".join(kinds)) if text
    )


def _schema(name: str, schema: Json) -> str:
    parts = [f"({_anchor(name)})=", f"### {name}\n"]
    if text := schema.get("description"):
        parts.append(f"{' '.join(text.split())}\n")
    if "enum" in schema:
        parts.append(f"One of {choices(schema['enum'])}.\n")
    if schema.get("properties"):
        parts.append(_fields(schema))
    return "\n".join(parts)


def _fields(schema: Json) -> str:
    required = schema.get("required", ())
    rows = [
        [code(name), _type(field), _meaning(field, required=name in required)]
        for name, field in schema["properties"].items()
    ]
    return table(["field", "type", "meaning"], rows)


def _meaning(field: Json, *, required: bool) -> str:
    parts = ["Required."] if required else []
    if text := field.get("description"):
        parts.append(text)
    default = field.get("default")
    if default is not None and default != {} and default != []:
        parts.append(f"Default: {code(json.dumps(default))}.")
    return " ".join(parts)


def _type(schema: Json) -> str:
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{_anchor(name)})"
    for several in ("anyOf", "oneOf"):
        if several in schema:
            return " or ".join(_type(one) for one in schema[several])
    if "allOf" in schema:
        return _type(schema["allOf"][0])
    if "const" in schema:
        return code(json.dumps(schema["const"]))
    if "enum" in schema:
        return choices(json.dumps(value) for value in schema["enum"])
    if schema.get("type") == "array":
        items = schema.get("items")
        return f"array of {_type(items)}" if items else f"array of {len(schema.get('prefixItems', ()))}"
    kind = str(schema.get("type", "any"))
    return f"{kind}{_range(schema)}"


def _range(schema: Json) -> str:
    low = schema.get("minimum", schema.get("exclusiveMinimum"))
    high = schema.get("maximum", schema.get("exclusiveMaximum"))
    if low is not None and high is not None:
        return f", {low:,} to {high:,}"
    return f", at least {low:,}" if low is not None else ""


def _anchor(schema: str) -> str:
    return f"schema-{schema.lower()}"
