"""The two kinds of message on the wire, and the number types they share."""

import math
from datetime import datetime
from typing import Annotated, Any

from pydantic import AwareDatetime, BaseModel, BeforeValidator, ConfigDict


class Request(BaseModel):
    """What a client sends. An unknown field is an error: a misspelt option must not pass unnoticed."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, validate_default=True)


class Response(BaseModel):
    """What the service sends. Unknown fields are ignored, so that an older SDK reads a newer server."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)


def _finite_or_none(value: Any) -> Any:
    # JSON has no NaN: a measurement that is not a number is one that is absent.
    return None if isinstance(value, float) and not math.isfinite(value) else value


Measured = Annotated[float | None, BeforeValidator(_finite_or_none)]
"""A measured number; NaN and infinities become None."""

Time = AwareDatetime
"""A moment with its time zone, ISO 8601 on the wire."""

__all__ = ["Measured", "Request", "Response", "Time", "datetime"]
