"""Proves that `splatmill_worker` offers the engine's names, each as its module defines it, and no others.

What importing costs is proved by tests/test_architecture.py, and what the names do by docs/programming/library.md,
which is run.
"""

import pytest

import splatmill_worker as sm


@pytest.mark.parametrize("name", sm.__all__)
def test_a_name_is_that_of_its_module(name: str):
    exported = getattr(sm, name)
    defined_in = getattr(exported, "__module__", None) or exported.__name__
    assert defined_in.startswith(f"splatmill_worker.{sm._MODULES[name].split('.')[0]}")


def test_all_names_are_listed():
    assert set(sm.__all__) == set(sm._MODULES) == set(dir(sm))


def test_another_name_is_refused():
    with pytest.raises(AttributeError, match=r"module 'splatmill_worker' has no attribute 'no_such_name'"):
        _ = sm.no_such_name
