"""The options of a training as a caller gives them: checked before anything is sent, with the model it starts from."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from splatmill.errors import invalid_request
from splatmill.schema import TrainOptions
from splatmill.schema.files.formats import is_start_file
from splatmill.transfer.local_capture import start_model


def with_start_model(
    options: Mapping[str, Any], folder: str | os.PathLike[str]
) -> tuple[dict[str, Any], Path | None]:
    """Return `options` with the path in `start` replaced by the name of the file in the capture, and that path or None.

    A relative path is looked up in the working folder, then in `folder`, the data set. Raises NothingToUpload where
    neither holds the file.
    """
    start = options.get("start")
    if start is None or not is_start_file(str(start)):
        return dict(options), None
    path = Path(start).expanduser()
    inside = Path(folder).expanduser() / path
    if not path.is_file() and inside.is_file():
        path = inside
    return {**options, "start": start_model(path).name}, path


def train_options(options: Mapping[str, Any]) -> TrainOptions:
    """Validate options. Raises InvalidRequest, with one clause per value that is not valid."""
    try:
        return TrainOptions.model_validate(dict(options))
    except ValidationError as error:
        unknown = any(entry["type"] == "extra_forbidden" for entry in error.errors())
        raise invalid_request(error, "unknown_option" if unknown else "option_out_of_range") from error
