"""`splatmill fit-image`: one picture as Gaussians in a plane, on this machine."""

from pathlib import Path
from typing import Annotated, Any

import typer

from splatmill.cli.embedded import require
from splatmill.cli.schema_options import with_options_of
from splatmill.cli.service import become
from splatmill.schema.fit_image import FitImageOptions


def _fit_image(
    photo: Annotated[
        Path,
        typer.Argument(
            metavar="PHOTO", help="The picture: JPEG, PNG, WebP, TIFF or HEIC.", show_default=False
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Folder for the results.")] = Path(
        "fit"
    ),
    **options: Any,
) -> None:
    """Fit one picture by Gaussians; leaves model.ply, picture.png and the curve of its error in DIR."""
    from pydantic import ValidationError

    from splatmill.errors import invalid

    try:
        checked = FitImageOptions.model_validate(
            {name: value for name, value in options.items() if value is not None}
        )
    except ValidationError as error:
        raise invalid(error, "option_out_of_range") from error
    require("splatmill_worker", "Fitting a picture")
    become(
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
