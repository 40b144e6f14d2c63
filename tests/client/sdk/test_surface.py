"""The two clients of the SDK are twins: the synchronous one follows from the other, and the package exports both.

Does not prove that a method of one does what its twin does; the synchronous methods call the asynchronous ones.
"""

import pytest

import splatmill
from tests.support import synchronous


@pytest.mark.parametrize("name", synchronous.SOURCES)
def test_the_synchronous_modules_are_those_that_the_asynchronous_ones_make(name: str):
    written = (synchronous.PACKAGE / name).read_text()
    assert written == synchronous.text(name), "run: make generated"


def test_what_the_package_exports_has_its_twin():
    for name in splatmill.__all__:
        assert getattr(splatmill, name) is not None
        assert name in splatmill.__dir__()
    for name in ("Client", "JobHandle", "ModelHandle"):
        assert {name, f"Async{name}"} <= set(splatmill.__all__)
