"""What the command line's exit codes mean, and how an error is told."""

import sys
from collections.abc import Iterator
from enum import IntEnum

from splatmill import errors


class Exit(IntEnum):
    """The exit codes, one per kind of ending that a script may want to tell apart."""

    done = 0
    error = 1  # the service made a mistake, or the disk refused
    usage = 2  # a wrong argument or option
    job_failed = 3
    unreachable = 4  # no server, or a part of it is down
    refused = 5  # the photos or the request cannot be used
    unauthorized = 6
    not_found = 7  # no such job or model, or not in the right state
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
)

MOST_ENTRIES = 10

USAGE_CODES = frozenset({"unknown_option", "option_out_of_range"})


def code_of(error: Exception) -> Exit:
    """The exit code for an error."""
    if isinstance(error, errors.Refused) and error.code in USAGE_CODES:
        return Exit.usage
    return next((code for kind, code in _CODES if isinstance(error, kind)), Exit.error)


def tell(error: Exception) -> Exit:
    """Print an error's sentence, its facts where a job failed, and its advice; return the exit code."""
    if isinstance(error, errors.SplatmillError):
        message, advice = error.message, error.advice
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
    return code_of(error)


def _shown(name: str, value: object) -> Iterator[str]:
    """A fact in lines: a list of files has one each, and an end."""
    if isinstance(value, list) and value:
        yield f"{name}:"
        yield from (f"  {entry}" for entry in value[:MOST_ENTRIES])
        if len(value) > MOST_ENTRIES:
            yield f"  and {len(value) - MOST_ENTRIES} more"
    else:
        yield f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value}"
