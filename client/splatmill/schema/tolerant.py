"""Reading of stored records that another version has written: what is readable is kept, the rest is left out."""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

T = TypeVar("T")


def keep_readable(
    validate: Callable[[Any], T], record: Mapping[str, Any], depth: int = 0
) -> tuple[T, list[str]]:
    """Validate a record, and leave out the fields that are not valid. Return the value and what was left out.

    validate: a pydantic validation of a JSON object.
    depth: number of parts of an error's location before the field's name: 1 for a discriminated union, else 0.

    What was left out is one text per field, with the reason. Raises ValidationError if what is left is not valid
    either, because a required field is missing or not readable.
    """
    try:
        return validate(dict(record)), []
    except ValidationError as error:
        unreadable = {
            str(entry["loc"][depth]): entry["msg"]
            for entry in error.errors(include_url=False, include_input=False)
            if len(entry["loc"]) > depth
        }
        kept = {name: value for name, value in record.items() if name not in unreadable}
        if len(kept) == len(record):
            raise
    value, more = keep_readable(validate, kept, depth)
    return value, [*(f"{name}: {reason}" for name, reason in unreadable.items()), *more]
