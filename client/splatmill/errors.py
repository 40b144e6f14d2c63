"""Every error the SDK raises.

SplatmillError
├── ConnectionFailed          no answer, or the connection was lost for good
├── Refused                   the server answered with a problem (`.problem`)
│   ├── InvalidRequest        something about the request or the upload has to change
│   ├── Unauthorized          the API key is missing, wrong, or may not do that
│   ├── NotFound              no such capture, job, model or file
│   ├── Conflict              the thing is in the wrong state, or the name is taken
│   ├── Unavailable           a part of the service is down or full; later may be better
│   └── ServerError           the service made a mistake
├── JobFailed                 the job ended without a model (`.problem` says why)
├── JobCancelled              the job was cancelled
├── NothingToUpload           the path holds nothing that could be trained
├── DownloadFailed            the bytes that arrived are not the file
└── ServiceFailed             the embedded service could not be started
"""

from typing import TYPE_CHECKING

from splatmill.schema.problems import Problem

if TYPE_CHECKING:
    from pydantic import ValidationError


class SplatmillError(Exception):
    """The base of all errors of the SDK: a sentence, and advice where there is some."""

    def __init__(self, message: str, advice: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.advice = advice

    def __str__(self) -> str:
        return f"{self.message} {self.advice}" if self.advice else self.message


class ConnectionFailed(SplatmillError):
    """No answer, or the connection was lost for good."""


class Refused(SplatmillError):
    """The server answered with a problem."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.detail, problem.advice)
        self.problem = problem

    @property
    def code(self) -> str:
        """The problem's stable code."""
        return self.problem.code


class InvalidRequest(Refused):
    """Something about the request or the upload has to change."""


class Unauthorized(Refused):
    """The API key is missing, wrong, or may not do that."""


class NotFound(Refused):
    """There is no such capture, job, model or file."""


class Conflict(Refused):
    """The thing is in the wrong state, or the name is taken."""


class Unavailable(Refused):
    """A part of the service is down or full; later may be better."""


class ServerError(Refused):
    """The service made a mistake."""


class JobFailed(SplatmillError):
    """The job ended without a model."""

    def __init__(self, job_id: str, problem: Problem) -> None:
        super().__init__(problem.detail, problem.advice)
        self.job_id = job_id
        self.problem = problem

    @property
    def code(self) -> str:
        """The problem's stable code."""
        return self.problem.code


class JobCancelled(SplatmillError):
    """The job was cancelled."""

    def __init__(self, job_id: str) -> None:
        super().__init__(f"The job {job_id} was cancelled.")
        self.job_id = job_id


class NothingToUpload(SplatmillError):
    """The path holds nothing that could be trained."""


class DownloadFailed(SplatmillError):
    """The bytes that arrived are not the file."""


class ServiceFailed(SplatmillError):
    """The embedded service could not be started."""


_BY_STATUS: dict[int, type[Refused]] = {
    401: Unauthorized,
    403: Unauthorized,
    404: NotFound,
    409: Conflict,
    429: Unavailable,
    503: Unavailable,
    504: Unavailable,
    507: Unavailable,
}


def refused(problem: Problem) -> Refused:
    """The error for a problem. The status decides: it is fixed for each code by the schema's table."""
    kind = _BY_STATUS.get(problem.status) or (InvalidRequest if problem.status < 500 else ServerError)
    return kind(problem)


def invalid(error: "ValidationError", code: str = "invalid_request") -> InvalidRequest:
    """The error for values that the schema refuses before anything is sent: one clause per value."""
    clauses = []
    for entry in error.errors(include_url=False):
        place = ".".join(str(part) for part in entry["loc"])
        message = entry["msg"].removeprefix("Value error, ")
        if entry["type"] == "extra_forbidden":
            clauses.append(f"there is no setting {place!r}")
        else:
            seen = f" (got {entry['input']!r})" if isinstance(entry["input"], str | int | float) else ""
            clauses.append(f"{place}: {message}{seen}" if place else message)
    text = "; ".join(clauses).removesuffix(".")
    return InvalidRequest(Problem.of(code, f"{text}."))
