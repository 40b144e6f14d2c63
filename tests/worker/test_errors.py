"""Proves that every error of the worker becomes a problem of the wire: its code is in the table, and it carries advice.

Does not prove that each place raises the right one.
"""

from __future__ import annotations

import ast
from http import HTTPStatus

import pytest

from splatmill.schema import PROBLEMS, Problem, code_for_status
from splatmill_worker import errors
from splatmill_worker.errors import FailureName, ModelUnreadable, TrainingFailed, WorkerError
from splatmill_worker.service.attempts.problems import problem_of
from tests.support.paths import ROOT


def raised_codes() -> dict[str, str]:
    """Every code given as a literal to an error of the tree anywhere in the worker, and the file that gives it."""
    tree = {
        name
        for name, kind in vars(errors).items()
        if isinstance(kind, type) and issubclass(kind, WorkerError)
    }
    codes = {}
    for path in (ROOT / "worker" / "splatmill_worker").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call) or not node.args:
                continue
            called = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            code = node.args[0]
            if (called in tree or (called == "__init__" and path.name == "errors.py")) and isinstance(
                code, ast.Constant
            ):
                codes[str(code.value)] = path.name
    return codes


def test_every_code_is_in_the_table_of_problems() -> None:
    codes = raised_codes()
    assert {"sfm_no_features", "holdout_empty", "poses_invalid", "model_corrupt"} <= codes.keys()
    assert {code: place for code, place in codes.items() if code not in PROBLEMS} == {}
    assert set(TrainingFailed.CODES.values()) <= PROBLEMS.keys()
    assert TrainingFailed.CODES.keys() == TrainingFailed.ADVICE.keys() == set(FailureName)


def test_every_code_of_the_table_is_given_somewhere() -> None:
    parts = ("client/splatmill", "server/splatmill_server", "worker/splatmill_worker")
    table = ROOT / "client/splatmill/schema/problems.py"
    texts = [p.read_text() for part in parts for p in (ROOT / part).rglob("*.py") if p != table]
    codes = {code for code in PROBLEMS if any(f'"{code}"' in text for text in texts)}
    assert PROBLEMS.keys() - codes - {code_for_status(status.value) for status in HTTPStatus} == set()


def test_a_code_that_is_not_given_any_more_is_still_read() -> None:
    stored = {
        "title": "The record of the job was lost",
        "status": 500,
        "detail": "It is gone.",
        "code": "job_lost",
    }
    assert Problem.model_validate(stored).code == "job_lost"


@pytest.mark.parametrize("name", FailureName)
def test_a_numerical_failure_is_a_problem_with_its_step_and_advice(name: FailureName) -> None:
    problem = problem_of(TrainingFailed(name, "the loss became nan.", step=7))
    assert problem.code == TrainingFailed.CODES[name]
    assert problem.facts == {"step": 7}
    assert (
        problem.sentence == f"Training stopped at step 7: the loss became nan. {TrainingFailed.ADVICE[name]}"
    )


def test_an_error_reads_as_its_message_and_advice() -> None:
    assert str(WorkerError("sfm_failed", "One thing.", advice="Do another.")) == "One thing. Do another."
    assert str(ModelUnreadable("x.ply is empty.")) == "x.ply is empty."
