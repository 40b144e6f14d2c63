"""A Redis that answers and refuses: its disk or memory is full, it is read-only, or it denies its user the command.

The service treats this like a Redis that cannot be reached: nothing was changed, and the same command works later. So
both raise redis.ConnectionError, which RQ handles as well.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import redis
from redis.client import Pipeline

_REFUSALS = (
    "MISCONF",  # it could not write its data to disk
    "OOM",  # it has used up its memory
    "READONLY",  # it became a replica of another one
    "NOREPLICAS",  # it has too few replicas to take writes
    "NOPERM",  # its access rules deny the command or the key
    "MOVED",  # a cluster keeps the key on another node
    "CLUSTERDOWN",
    "TRYAGAIN",
    "MASTERDOWN",
)
_CODE = re.compile(rf"(?:^|[ -])({'|'.join(_REFUSALS)})\b")
_SCRIPT_DENIED = ("The user executing the script", "ACL failure in script")
"""What Redis 7 and Valkey answer, without a code, where a script calls a command that the user may not."""

_CODE_OF: dict[type[redis.RedisError], str] = {
    redis.exceptions.OutOfMemoryError: "OOM",
    redis.exceptions.ReadOnlyError: "READONLY",
    redis.exceptions.NoPermissionError: "NOPERM",
    redis.exceptions.MovedError: "MOVED",
    redis.exceptions.ClusterDownError: "CLUSTERDOWN",
    redis.exceptions.TryAgainError: "TRYAGAIN",
    redis.exceptions.MasterDownError: "MASTERDOWN",
}


class RedisRefuses(redis.ConnectionError, redis.ResponseError):
    """Redis refuses a command for as long as its state stays as it is. The message begins with its code."""


class RefusalAwareRedis(redis.Redis):
    """A client that raises RedisRefuses for refusals."""

    def execute_command(self, *args: Any, **options: Any) -> Any:
        with refusals():
            return super().execute_command(*args, **options)  # type: ignore[no-untyped-call]  # redis leaves it untyped

    def pipeline(self, transaction: bool = True, shard_hint: str | None = None) -> Pipeline:
        """Return a pipeline that raises RedisRefuses for refusals."""
        return _Pipeline(self.connection_pool, self.response_callbacks, transaction, shard_hint)


class _Pipeline(Pipeline):
    def execute(self, raise_on_error: bool = True) -> list[Any]:
        with refusals():
            return super().execute(raise_on_error)

    def immediate_execute_command(self, *args: Any, **options: Any) -> Any:
        with refusals():
            return super().immediate_execute_command(*args, **options)  # type: ignore[no-untyped-call]  # redis leaves it untyped


def code_of(error: redis.ResponseError) -> str | None:
    """Return the code of a refusal, or None for another error."""
    for kind, code in _CODE_OF.items():
        if isinstance(error, kind):
            return code
    match = _CODE.search(str(error))
    if match is None and any(text in str(error) for text in _SCRIPT_DENIED):
        return "NOPERM"
    return match[1] if match else None


@contextmanager
def refusals() -> Iterator[None]:
    """Raise RedisRefuses for refusals in the block."""
    try:
        yield
    except RedisRefuses:
        raise
    except redis.ResponseError as error:
        code = code_of(error)
        if code is None:
            raise
        text = str(error)
        raise RedisRefuses(text if code in text else f"{code} {text}") from error
