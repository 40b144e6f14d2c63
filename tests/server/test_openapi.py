"""Requests made up from the OpenAPI document: no answer is a 500, and each is one that the document describes.

Short on purpose: breadth over all operations rather than depth in one. Not proved here: behaviour (other files).
"""

from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from schemathesis.checks import not_a_server_error
from schemathesis.core.result import Ok
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from tests.support.served_app import Serve

pytestmark = pytest.mark.slow

schemathesis.serializer.alias("application/partial-upload", "application/octet-stream")

CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]


def test_the_document_says_what_needs_no_key_and_what_a_body_may_meet(serve: Serve) -> None:
    document = serve(api_key="s3cret").http.get("/openapi.json").json()
    open_addresses = {
        path for path, each in document["paths"].items() for one in each.values() if one.get("security") == []
    }
    assert {"/healthz", "/readyz", "/s/{token}/model/render"} <= open_addresses
    assert not any(path.startswith("/v1/") for path in open_addresses)
    for path, each in document["paths"].items():
        for method, operation in each.items():
            content = operation.get("requestBody", {}).get("content", {})
            if "application/json" in content:
                assert {"400", "413", "415"} <= operation["responses"].keys(), (method, path)


def test_made_up_requests_get_described_answers(serve: Serve) -> None:
    app = serve(api_key="s3cret")  # a stored key that a made-up request makes does not close the server
    schema = schemathesis.openapi.from_url(f"{str(app.http.base_url).rstrip('/')}/openapi.json")
    tried = 0
    for result in schema.get_all_operations():
        assert isinstance(result, Ok)
        operation: Any = result.ok()
        if operation.path.endswith("/events"):
            continue  # An endless answer; test_events reads it.

        @settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
        @given(case=operation.as_strategy())
        def check(case: Any) -> None:
            case.call_and_validate(checks=CHECKS, headers={"Authorization": "Bearer s3cret"})

        check()
        tried += 1
    assert tried > 20
