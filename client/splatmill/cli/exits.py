"""The exit codes of the command line, and how errors are printed."""

import sys
from collections.abc import Iterator
from enum import IntEnum

from splatmill import errors


class Exit(IntEnum):
    """The exit codes: one for each outcome that a script may need to distinguish."""

    done = 0
    error = 1  # the service failed, or a file could not be written
    usage = 2  # a wrong argument or option
    job_failed = 3
    unreachable = 4  # the server or a part of it does not answer
    refused = 5  # the photos or the request are not valid
    unauthorized = 6  # the API key is missing or wrong, or does not permit the request
    not_found = 7  # no such job or model, or it is in the wrong state
    no_service = 8  # the embedded service could not be started
    cancelled = 130  # by Ctrl-C, SIGTERM or another client


_CODES: tuple[tuple[type[Exception], Exit], ...] = (
    (errors.JobFailed, Exit.job_failed),
    (errors.JobCancelled, Exit.cancelled),
    (errors.ConnectionFailed, Exit.unreachable),
    (errors.Unavailable, Exit.unreachable),
    (errors.Unauthorized, Exit.unauthorized),
    (errors.NotFound, Exit.not_found),
    (errors.Conflict, Exit.not_found),
    (errors.InvalidRequest, Exit.refused),
    (errors.NothingToUpload, Exit.refused),
    (errors.ServiceFailed, Exit.no_service),
    (errors.ConfigurationInvalid, Exit.usage),
)

MOST_ENTRIES = 10  # of a list among the facts of a problem

USAGE_CODES = frozenset({"unknown_option", "option_out_of_range"})


_ADVICE = {
    "job_not_found": "`splatmill jobs` lists the jobs.",
    "capture_not_found": "`splatmill captures` lists the captures.",
    "model_not_found": "`splatmill models` lists the models.",
    "job_running": "Wait until it has ended, or cancel it: splatmill cancel {job}",
    "job_finished": "Delete it if it is no longer needed: splatmill delete {job}",
    "capture_in_use": "Wait until its job has ended, or cancel it: splatmill cancel {job}",
    "model_not_ready": "See how its job gets on: splatmill follow {job}",
}
"""What to do on the command line, by the code of a problem whose own advice is a request of the REST API."""


def advice_of(error: errors.SplatmillError) -> str | None:
    """Return what a person on the command line can do about an error."""
    if not isinstance(error, errors.Refused) or "/v1/" not in (error.advice or ""):
        return error.advice
    known = _ADVICE.get(error.code, error.advice)
    return known.replace("{job}", str(error.problem.facts.get("job", "JOB"))) if known else None


def code_of(error: Exception) -> Exit:
    """Return the exit code for an error."""
    if isinstance(error, errors.Refused) and error.code in USAGE_CODES:
        return Exit.usage
    return next((code for kind, code in _CODES if isinstance(error, kind)), Exit.error)


def print_error(error: Exception) -> Exit:
    """Print the message of an error, the facts of a failed job, and the advice; return the exit code."""
    if isinstance(error, errors.SplatmillError):
        message, advice = error.message, advice_of(error)
    elif isinstance(error, OSError):
        place = f"{error.filename}: " if error.filename else ""
        message, advice = f"{place}{error.strerror or error}.", None
    else:
        message, advice = f"{error}", None
    print(f"Error: {message}", file=sys.stderr)
    if isinstance(error, errors.JobFailed):
        for name, value in error.problem.facts.items():
            for line in _shown(name.replace("_", " "), value):
                print(f"  {line}", file=sys.stderr)
    if advice:
        print(advice, file=sys.stderr)
    if isinstance(error, errors.Unavailable) and error.retry_after:
        from splatmill.schema import format_duration

        print(f"The server asks to try again in {format_duration(error.retry_after)}.", file=sys.stderr)
    return code_of(error)


def _shown(name: str, value: object) -> Iterator[str]:
    """Yield the lines that show a fact: one for each entry of a list, up to a limit."""
    if isinstance(value, list) and value:
        yield f"{name}:"
        yield from (f"  {entry}" for entry in value[:MOST_ENTRIES])
        if len(value) > MOST_ENTRIES:
            yield f"  and {len(value) - MOST_ENTRIES} more"
    else:
        yield f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value}"
