"""The errors that the SDK raises.

SplatmillError
├── ConnectionFailed          the server does not answer, or the connection was lost
├── Refused                   the server refused the request (`.problem` says why)
│   ├── InvalidRequest        the request or the uploaded file is not valid
│   ├── Unauthorized          the API key is missing or wrong
│   │   └── Forbidden         the API key does not permit the request
│   ├── NotFound              there is no such capture, job, model or file, or it was deleted
│   ├── Conflict              the job or model is in the wrong state, or the name is taken
│   ├── Unavailable           a part of the service is down or full; try again later
│   │   └── TooManyRequests   the caller has sent or started more than it may (`.retry_after` says when to go on)
│   └── ServerError           the service failed to handle the request
├── JobFailed                 the job ended without a model (`.problem` says why)
├── JobCancelled              the job was cancelled
├── WaitTimeout               the job has not ended within the given time; it continues
├── NothingToUpload           the path holds no photos, video or zip archive
├── ConfigurationInvalid      a profile, or the certificates to trust, cannot be used
├── DownloadFailed            the downloaded bytes are not those of the file
└── ServiceFailed             the embedded service could not be started
"""

from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from splatmill.schema.problems import Problem

M = TypeVar("M", bound=BaseModel)


class SplatmillError(Exception):
    """The base class of all errors of the SDK. `message` says what happened, `advice` what to do, if anything."""

    def __init__(self, message: str, advice: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.advice = advice

    def __str__(self) -> str:
        return f"{self.message} {self.advice}" if self.advice else self.message


class ConnectionFailed(SplatmillError):
    """The server does not answer, or the connection was lost and could not be restored."""


class Refused(SplatmillError):
    """The server refused the request. `problem` is its answer."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.detail, problem.advice)
        self.problem = problem

    @property
    def code(self) -> str:
        """The stable code of the problem."""
        return self.problem.code


class InvalidRequest(Refused):
    """The request or the uploaded file is not valid, and has to be changed."""


class Unauthorized(Refused):
    """The API key is missing or wrong, or does not permit the request (`Forbidden`)."""


class Forbidden(Unauthorized):
    """The API key is valid and does not permit the request."""


class NotFound(Refused):
    """There is no such capture, job, model or file, or it was deleted."""


class Conflict(Refused):
    """The job or model is in the wrong state for the request, or the name is taken."""


class Unavailable(Refused):
    """A part of the service is down or full. Try again later.

    `retry_after` is the number of seconds after which the server asks to try again, or None if it named no time.
    """

    def __init__(self, problem: Problem, retry_after: float | None = None) -> None:
        super().__init__(problem)
        self.retry_after = retry_after


class TooManyRequests(Unavailable):
    """The caller has sent more requests, or has more unfinished jobs, than it may.

    Try again after `retry_after` seconds, if that is given.
    """


class ServerError(Refused):
    """The service failed to handle the request."""


class JobFailed(SplatmillError):
    """The job ended without a model. `problem` is the reason."""

    def __init__(self, job_id: str, problem: Problem) -> None:
        super().__init__(problem.detail, problem.advice)
        self.job_id = job_id
        self.problem = problem

    @property
    def code(self) -> str:
        """The stable code of the problem."""
        return self.problem.code


class JobCancelled(SplatmillError):
    """The job was cancelled."""

    def __init__(self, job_id: str) -> None:
        super().__init__(f"The job {job_id} was cancelled.")
        self.job_id = job_id


class WaitTimeout(SplatmillError, TimeoutError):
    """The job, the orbit video or the mesh has not ended within the given time. It continues.

    job_id: the id of the job, the video or the mesh.
    state: the state in which it was last seen.
    """

    def __init__(self, job_id: str, state: str, seconds: float, what: str = "job") -> None:
        super().__init__(
            f"The {what} {job_id} has not ended within {seconds:g} seconds; its state is {state}.",
            "It continues on the server; wait for it again, or cancel it.",
        )
        self.job_id = job_id
        self.state = state
        self.seconds = seconds


class NothingToUpload(SplatmillError):
    """The path holds no photos, video or zip archive, or a file that cannot be read or uploaded."""


class ConfigurationInvalid(SplatmillError):
    """A profile, or the certificates to trust, cannot be used."""


class DownloadFailed(SplatmillError):
    """The downloaded bytes are not those of the file."""


class ServiceFailed(SplatmillError):
    """The embedded service could not be started."""


_BY_STATUS: dict[int, type[Refused]] = {
    401: Unauthorized,
    403: Forbidden,
    404: NotFound,
    409: Conflict,
    429: TooManyRequests,
    503: Unavailable,
    504: Unavailable,
    507: Unavailable,
}


def error_for(problem: Problem, retry_after: float | None = None) -> Refused:
    """Return the error for a problem. Its class follows from the HTTP status, which is fixed for each code.

    retry_after: seconds after which the server asks to try again, if it named a time.
    """
    kind = _BY_STATUS.get(problem.status) or (InvalidRequest if problem.status < 500 else ServerError)
    return kind(problem, retry_after) if issubclass(kind, Unavailable) else kind(problem)


def valid_request(kind: type[M], values: Any, code: str = "invalid_request") -> M:
    """Return an instance of the schema's class `kind` with these values, or with those of a JSON text in bytes.

    code: of the problem. Raises InvalidRequest, with one clause per value that the schema rejects.
    """
    try:
        if isinstance(values, bytes):
            return kind.model_validate_json(values)
        return kind.model_validate(values)
    except ValidationError as error:
        raise invalid_request(error, code) from error


def invalid_request(error: ValidationError, code: str = "invalid_request") -> InvalidRequest:
    """Return the error for values that the schema rejects before anything is sent, with one clause per value."""
    clauses = []
    for entry in error.errors(include_url=False):
        place = ".".join(str(part) for part in entry["loc"])
        message = entry["msg"].removeprefix("Value error, ")
        if entry["type"] == "extra_forbidden":
            clauses.append(f"there is no option {place!r}")
        elif entry["type"] == "conflict":  # the sentence names both options, each of which has it
            clauses.append(message.removesuffix("."))
        else:
            value = f" (got {entry['input']!r})" if isinstance(entry["input"], str | int | float) else ""
            clauses.append(f"{place}: {message}{value}" if place else message)
    text = "; ".join(dict.fromkeys(clauses)).removesuffix(".")
    return InvalidRequest(Problem.of(code, f"{text}."))
