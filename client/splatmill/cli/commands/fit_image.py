"""`splatmill fit-image`: fits one picture with Gaussians in a plane, on this machine."""

from pathlib import Path
from typing import Annotated, Any

import typer

from splatmill.cli.local.programs import exec_module, require
from splatmill.cli.schema_options import with_options_of
from splatmill.schema.fit_image import FitImageOptions


def _fit_image(
    photo: Annotated[
        Path,
        typer.Argument(
            metavar="PHOTO", help="Picture to fit: JPEG, PNG, WebP, TIFF, HEIC or AVIF.", show_default=False
        ),
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="DIR", help="Folder for the results; created if missing.")
    ] = Path("fit"),
    **options: Any,
) -> None:
    """Fit one picture with Gaussians; write the model, picture.png and the error over time to DIR."""
    from splatmill.errors import valid_request

    checked = valid_request(
        FitImageOptions,
        {name: value for name, value in options.items() if value is not None},
        "option_out_of_range",
    )
    require("splatmill_worker", "Fitting a picture")
    exec_module(
        "splatmill_worker",
        "fit-image",
        "--out",
        str(out),
        "--options",
        checked.model_dump_json(),
        "--",
        str(photo),
    )


fit_image = with_options_of(FitImageOptions, _fit_image)
