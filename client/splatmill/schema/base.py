"""The base classes of all messages on the wire, and the number and time types they share."""

import math
import unicodedata
from datetime import datetime
from typing import Annotated, Any

from pydantic import AfterValidator, AwareDatetime, BaseModel, BeforeValidator, ConfigDict, Field

from splatmill.schema.quantities import parse_bytes, parse_duration


class Request(BaseModel):
    """A message from a client. An unknown field is an error, so that a misspelt option does not pass unnoticed."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, validate_default=True)


class Response(BaseModel):
    """A message from the service. Unknown fields are ignored, so that an older SDK can read a newer server."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)


def _finite_or_none(value: Any) -> Any:
    # JSON has no NaN, so a measurement that is not finite counts as absent.
    return None if isinstance(value, float) and not math.isfinite(value) else value


Measured = Annotated[float | None, BeforeValidator(_finite_or_none)]
"""A measured number, or None where nothing was measured. NaN and infinities become None."""

Duration = Annotated[float, BeforeValidator(parse_duration)]
"""Seconds; `parse_duration` accepts a text such as `5m`."""

ByteSize = Annotated[int, BeforeValidator(parse_bytes)]
"""Bytes; `parse_bytes` accepts a text such as `1.5GB`."""


def without_controls(text: str) -> str:
    """Return a text that people will read. Raises ValueError if it holds a control character or a line separator."""
    if any(unicodedata.category(char) in ("Cc", "Zl", "Zp") for char in text):
        raise ValueError("it contains a control character, which would act on the terminals that show it")
    return text


Label = Annotated[str, Field(max_length=200), AfterValidator(without_controls)]
"""A name that a client gives to something, to recognise it by."""

Time = AwareDatetime
"""A point in time with its time zone; ISO 8601 on the wire."""

__all__ = ["Label", "Measured", "Request", "Response", "Time", "datetime"]
