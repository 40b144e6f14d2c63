"""The two clients of the SDK are twins: the same names, parameters, results and first sentences.

Does not prove that a method of one does what its twin does; the synchronous methods call the asynchronous ones.
"""

import inspect
import re
from typing import Any, get_type_hints

import pytest

import splatmill
from splatmill import aio, client, imports, job, keys, model, orbits, shares, webhooks

TWINS = [
    (client.Client, aio.AsyncClient),
    (client.JobHandle, job.AsyncJobHandle),
    (client.ModelHandle, model.AsyncModelHandle),
    (keys.Keys, keys.AsyncKeys),
    (webhooks.Webhooks, webhooks.AsyncWebhooks),
    (orbits.Orbits, orbits.AsyncOrbits),
    (shares.Shares, shares.AsyncShares),
    (imports.Imports, imports.AsyncImports),
]
ATTRIBUTES = {
    aio.AsyncClient: {"connection"},
    job.AsyncJobHandle: {"connection", "job", "refused", "renamed"},
    model.AsyncModelHandle: {"connection", "model"},
}
"""Names that the asynchronous classes set in `__init__`, where the synchronous ones have properties."""

ONLY_ASYNCHRONOUS = {"connection"}
"""The synchronous client uses the connection of the asynchronous one, on a loop of its own."""

CONTEXT = {"__enter__": "__aenter__", "__exit__": "__aexit__"}


def public(kind: type) -> set[str]:
    names = {name for name in vars(kind) if not name.startswith("_")}
    return (names | ATTRIBUTES.get(kind, set())) - ONLY_ASYNCHRONOUS


def said(annotation: Any) -> str:
    """An annotation as text, with the name of the synchronous twin in place of the asynchronous one."""
    text = annotation.__qualname__ if isinstance(annotation, type) else str(annotation)
    return re.sub(r"\b[\w.]*\.", "", text).replace("Async", "")


def result(function: Any) -> str:
    return said(get_type_hints(function).get("return"))


@pytest.mark.parametrize(("plain", "asynchronous"), TWINS)
def test_both_have_the_same_names(plain: type, asynchronous: type):
    assert public(plain) == public(asynchronous)
    assert {CONTEXT[name] for name in vars(plain) if name in CONTEXT} == {
        name for name in vars(asynchronous) if name in CONTEXT.values()
    }


@pytest.mark.parametrize(("plain", "asynchronous"), TWINS)
def test_methods_take_and_return_the_same(plain: type, asynchronous: type):
    for name in public(plain) - ATTRIBUTES.get(asynchronous, set()) | {"__init__"}:
        one, other = vars(plain)[name], vars(asynchronous)[name]
        if isinstance(one, property):
            assert result(one.fget) == result(other.fget), name
            continue
        if plain is client.Client or name != "__init__":  # the others are made by their client
            assert parameters(one) == parameters(other), name
        assert result(one) == result(other), name
        generator = inspect.isasyncgenfunction(other) or result(other).startswith("Iterator")
        assert generator or inspect.iscoroutinefunction(other) or name == "__init__", f"{name} blocks"


def parameters(function: Any) -> list[tuple[str, Any, Any, str]]:
    hints = get_type_hints(function)
    return [
        (parameter.name, parameter.kind, parameter.default, said(hints.get(parameter.name)))
        for parameter in inspect.signature(function).parameters.values()
    ]


@pytest.mark.parametrize(("plain", "asynchronous"), TWINS)
def test_methods_are_described_by_the_same_sentence(plain: type, asynchronous: type):
    if plain is client.Client:
        assert inspect.getdoc(plain) == inspect.getdoc(asynchronous)
    for name in public(plain) - ATTRIBUTES.get(asynchronous, set()):
        one, other = (inspect.getdoc(vars(kind)[name]) for kind in (plain, asynchronous))
        assert one
        assert other
        assert one.splitlines()[0] == other.splitlines()[0]


def test_what_the_package_exports_has_its_twin():
    for name in splatmill.__all__:
        assert getattr(splatmill, name) is not None
        assert name in splatmill.__dir__()
    for plain, asynchronous in TWINS[:3]:
        assert {plain.__name__, asynchronous.__name__} <= set(splatmill.__all__)
