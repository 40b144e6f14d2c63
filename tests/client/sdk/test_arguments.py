"""The keyword arguments of the SDK are known to editors and type checkers, and are those of the schema.

mypy checks this file: an ignored error that mypy does not find is an error of `make check`.
"""

from pathlib import Path

import pytest
from pydantic import ValidationError

from splatmill import Client
from splatmill.errors import InvalidRequest
from splatmill.schema import TrainOptions
from splatmill.sdk.arguments import TrainArguments
from tests.support import arguments


def test_the_module_follows_from_the_schema():
    assert arguments.PATH.read_text() == arguments.text(), "run: make generated"


def test_every_setting_is_an_argument():
    assert list(TrainArguments.__annotations__) == list(TrainOptions.model_fields)


def test_a_misspelt_argument_is_found_by_the_type_checker_and_refused(tmp_path: Path) -> None:
    with Client("http://127.0.0.1:9", retries=0) as client:
        with pytest.raises(InvalidRequest, match="there is no option 'time_budgt'"):
            client.train(tmp_path, time_budgt="5m")  # type: ignore[call-arg]  # the error is what is tested
        with pytest.raises(InvalidRequest, match="preset"):
            client.train(tmp_path, preset="best")  # type: ignore[arg-type]  # the error is what is tested


def test_what_the_types_permit_is_accepted() -> None:
    keywords: TrainArguments = {"time_budget": "5m", "max_memory": "2GiB", "preset": "draft", "seed": 3}
    options = TrainOptions.model_validate(keywords)
    assert (options.time_budget, options.max_memory, options.preset) == (300, 2 << 30, "draft")
    with pytest.raises(ValidationError):
        TrainOptions.model_validate({"preset": "best"})
