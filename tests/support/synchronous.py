"""The synchronous SDK as it follows from the asynchronous one. `make generated` writes it.

A synchronous method waits for the asynchronous one of its name, on a loop of its own (`splatmill.sdk.loop`). A copy
without `async` and `await`, as unasync writes, would be no client of the same interface: transports such as
`httpx.ASGITransport` are asynchronous, files are sent several at a time, and waits end by `asyncio.timeout`.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from tests.support.paths import ROOT

PACKAGE = ROOT / "client" / "splatmill" / "sdk"

SOURCES = {
    "client_records.py": ("bin", "imports", "keys", "meshes", "orbits", "shares", "webhooks"),
    "client.py": ("model", "job", "aio"),
}
"""The modules of asynchronous classes for each generated file. A class stands after those that its methods return."""

Function = ast.FunctionDef | ast.AsyncFunctionDef

_LIFE = """
    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        '''Close the connections.'''
        if not self._loop.closed:
            self._loop.run(self._async.close())
            self._loop.close()
"""
"""The methods of the client that end its loop."""


def text(name: str) -> str:
    """The whole module with the file name `name`."""
    sources = {module: (PACKAGE / f"{module}.py").read_text() for module in SOURCES[name]}
    made = f'"""The synchronous twins of the classes in {", ".join(f"`{module}`" for module in sources)}.\n\n'
    made += 'Generated from these by `make generated`.\n"""\n'
    made += "from collections.abc import Iterator\nfrom splatmill.sdk.loop import BackgroundLoop\n"
    if name == "client.py":
        made += (
            "from splatmill.sdk.client_records import Bin, Imports, Keys, Meshes, Orbits, Shares, Webhooks\n"
        )
    classes = []
    for module, source in sources.items():
        for node in ast.parse(source).body:
            match node:
                case ast.Import() | ast.ImportFrom():
                    made += ast.unparse(node) + "\n"
                case ast.Assign(targets=[ast.Name(id=constant)]) if constant.isupper():
                    made += f"from splatmill.sdk.{module} import {constant}\n"
                case ast.ClassDef(name=kind) if kind.startswith("Async"):
                    made += f"from splatmill.sdk.{module} import {kind}\n"
                    classes.append(_twin(source, node))
    made += "".join(classes)
    for command in (("check", "--fix", "--select", "F401,I"), ("format",)):
        ruff = [
            Path(sys.executable).with_name("ruff"),
            *command,
            "--quiet",
            "--stdin-filename",
            PACKAGE / name,
            "-",
        ]
        made = subprocess.run(ruff, input=made, capture_output=True, text=True, check=True).stdout
    return made


def _twin(source: str, node: ast.ClassDef) -> str:
    """The synchronous class of an asynchronous one."""
    first, *functions = (member for member in node.body if isinstance(member, Function))
    made = f"\nclass {_renamed(node.name)}:\n    {ast.get_source_segment(source, node.body[0])}\n"
    client = node.name == "AsyncClient"
    if client:
        made += f"\n    {_signature(first)}\n        self._async = {_call(node.name, first)}\n"
        made += "        self._loop = BackgroundLoop()\n"
    else:
        made += f"\n    def __init__(self, loop: BackgroundLoop, twin: {node.name}) -> None:\n"
        made += "        self._loop = loop\n        self._async = twin\n"
    properties = ""
    for name, kind, doc in _attributes(first):
        if kind.startswith("Async"):
            made += f"        self.{name} = {_renamed(kind)}(self._loop, self._async.{name})\n"
        else:
            properties += f"\n    @property\n    def {name}(self) -> {kind}:\n        '''{doc}'''\n"
            properties += f"        return self._async.{name}\n"
    made += (_LIFE if client else "") + properties
    shown = [
        one for one in functions if not one.name.startswith("_") and not (client and one.name == "close")
    ]
    return made + "".join(_method(source, function) for function in shown)


def _attributes(init: Function) -> Iterator[tuple[str, str, str]]:
    """Name, type and description of the public attributes that an `__init__` sets, but the connection."""
    types = {each.arg: ast.unparse(each.annotation) for each in init.args.args if each.annotation}
    for statement, after in pairwise([*init.body, ast.Pass()]):
        match statement:
            case ast.Assign(targets=[ast.Attribute(attr=name)], value=ast.Call(func=ast.Name(id=kind))):
                pass
            case ast.Assign(targets=[ast.Attribute(attr=name)], value=ast.Name(id=value)):
                kind = types[value]
            case ast.AnnAssign(target=ast.Attribute(attr=name), annotation=annotation):
                kind = ast.unparse(annotation)
            case _:
                continue
        if name != "connection" and not name.startswith("_"):
            yield name, kind, ast.literal_eval(after.value) if isinstance(after, ast.Expr) else ""


def _method(source: str, function: Function) -> str:
    """The method or property that waits for an asynchronous one. Raises TypeError for one that would block."""
    returned = ast.unparse(function.returns) if function.returns else ""
    value = _call(f"self._async.{function.name}", function)
    decorators = [ast.unparse(each) for each in function.decorator_list]
    if decorators == ["property"]:
        value = f"self._async.{function.name}"
    elif returned.startswith("AsyncIterator["):
        value = f"self._loop.iterate({value})"
    elif not isinstance(function, ast.AsyncFunctionDef):
        raise TypeError(f"{function.name} is neither asynchronous nor an iterator")
    elif "on_progress" in _names(function):
        value = f"self._loop.run_reporting(lambda report: {value}, on_progress)"
    else:
        value = f"self._loop.run({value})"
    if returned.startswith("Async") and "[" not in returned:
        value = f"{_renamed(returned)}(self._loop, {value})"
    lines = [*(f"@{each}" for each in decorators), _signature(function)]
    lines += [f"    {ast.get_source_segment(source, function.body[0])}"]
    lines += [f"    {value}" if returned == "None" else f"    return {value}"]
    return "\n" + "".join(f"    {line}\n" for line in lines)


def _signature(function: Function) -> str:
    """The first line of the synchronous function."""
    returned = ast.unparse(function.returns) if function.returns else "None"
    return _renamed(f"def {function.name}({ast.unparse(function.args)}) -> {returned}:")


def _renamed(annotation: str) -> str:
    """An annotation with the synchronous names of our types."""
    return re.sub(r"(?<![.\w])Async(?=[A-Z])", "", annotation)


def _call(callee: str, function: Function) -> str:
    """The call of the asynchronous function with the parameters of the synchronous one."""
    positional = len(function.args.args) - 1
    arguments = [
        ("" if place < positional else f"{name}=") + ("report" if name == "on_progress" else name)
        for place, name in enumerate(_names(function))
    ]
    arguments += [f"**{function.args.kwarg.arg}"] if function.args.kwarg else []
    return f"{callee}({', '.join(arguments)})"


def _names(function: Function) -> list[str]:
    """The parameters of a method but self."""
    return [each.arg for each in (*function.args.args[1:], *function.args.kwonlyargs)]
