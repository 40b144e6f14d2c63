"""The SDK's errors: each problem becomes the error its status calls for, and each reads as sentences.

Does not prove that the server answers with these problems; the server's tests do.
"""

import pytest
from pydantic import ValidationError

from splatmill import errors
from splatmill.cli.exits import Exit, print_error
from splatmill.schema import PROBLEMS, CameraSpec, Problem
from splatmill.transfer.training_options import train_options


@pytest.mark.parametrize("code", sorted(PROBLEMS))
def test_every_problem_has_its_error(code: str):
    status = PROBLEMS[code].status
    error = errors.error_for(Problem.of(code, "It was so.", advice="Do that."))
    expected = {
        401: errors.Unauthorized,
        403: errors.Forbidden,
        404: errors.NotFound,
        409: errors.Conflict,
        429: errors.TooManyRequests,
        500: errors.ServerError,
        502: errors.ServerError,
        503: errors.Unavailable,
        504: errors.Unavailable,
        507: errors.Unavailable,
    }.get(status, errors.InvalidRequest)
    assert type(error) is expected
    assert error.code == code
    assert str(error) == "It was so. Do that."


@pytest.mark.parametrize(
    ("code", "status", "waits"),
    [
        ("unauthorized", Exit.unauthorized, ""),
        ("forbidden", Exit.unauthorized, ""),
        ("job_not_found", Exit.not_found, ""),
        ("job_running", Exit.not_found, ""),
        ("too_many_requests", Exit.unreachable, "The server asks to try again in 1m30s.\n"),
        ("queue_unavailable", Exit.unreachable, "The server asks to try again in 1m30s.\n"),
        ("storage_full", Exit.unreachable, "The server asks to try again in 1m30s.\n"),
        ("invalid_request", Exit.refused, ""),
        ("internal_error", Exit.error, ""),
    ],
)
def test_the_command_line_prints_the_sentence_and_ends_with_its_status(capsys, code, status, waits):
    error = errors.error_for(Problem.of(code, "It was so.", advice="Do that."), 90.0)
    assert print_error(error) is status
    assert capsys.readouterr().err == f"Error: It was so.\nDo that.\n{waits}"


def test_the_command_line_advises_commands_in_place_of_requests(capsys):
    for code, facts, said in (
        ("job_not_found", {}, "`splatmill jobs` lists the jobs."),
        ("capture_in_use", {"job": "j1"}, "cancel it: splatmill cancel j1"),
        ("job_running", {}, "cancel it: splatmill cancel JOB"),
        ("cursor_invalid", {}, "GET /v1/jobs"),
    ):
        print_error(errors.error_for(Problem.of(code, "So.", facts=facts, advice="GET /v1/jobs")))
        assert said in capsys.readouterr().err
    own = Problem.of("job_running", "So.", advice="Do that.")
    print_error(errors.error_for(own))
    assert capsys.readouterr().err == "Error: So.\nDo that.\n"


def test_the_tree_drawn_at_the_top_is_the_tree():
    drawn = [
        line.replace("│", " ").split("── ")[1].split()[0]
        for line in (errors.__doc__ or "").splitlines()
        if "── " in line
    ]
    real = {
        name
        for name, value in vars(errors).items()
        if isinstance(value, type) and issubclass(value, errors.SplatmillError) and name != "SplatmillError"
    }
    assert set(drawn) == real
    assert len(drawn) == len(real)


def test_several_wrong_options_are_told_at_once():
    with pytest.raises(errors.InvalidRequest) as refused:
        train_options({"steps": 0, "holdout": "many", "colour": 1})
    text = str(refused.value)
    assert "steps: Input should be greater than or equal to 1 (got 0)" in text
    assert "there is no option 'colour'" in text
    assert refused.value.code == "unknown_option"


def test_a_rule_of_ours_is_told_without_pydantic_words():
    with pytest.raises(ValidationError) as wrong:
        CameraSpec.model_validate(
            {"camera_to_world": [[1, 0, 0, 0]] * 4, "width": 8, "height": 8, "fov_y_deg": 40}
        )
    text = str(errors.invalid_request(wrong.value))
    assert text == "The last row of camera_to_world is [1.0, 0.0, 0.0, 0.0]; it must be [0, 0, 0, 1]."
