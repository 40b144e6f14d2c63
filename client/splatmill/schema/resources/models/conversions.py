"""A model in other file formats: what each costs in bytes and quality, and the conversion of one."""

from enum import StrEnum

from pydantic import Field

from splatmill.schema.base import Measured, Request, Response


class ComparedWith(StrEnum):
    """What renderings of a converted model are compared with: held-out photos, or renderings of the model itself."""

    held_out = "held_out"
    renderings = "renderings"


class Conversion(Response):
    """What came out of a conversion: the contents of the record beside a converted file."""

    model: str = Field(description="ETag of the model.ply that was converted.")
    version: int = Field(description="Version of the converters; files of earlier ones are made again.")
    gaussians: int = Field(ge=0, description="Number of Gaussians in the file.")
    seconds: float = Field(ge=0, description="Duration of the conversion, without the comparison.")
    compared_with: ComparedWith | None = Field(
        default=None, description="What PSNR and SSIM are measured against; null where nothing was measured."
    )
    pictures: int = Field(default=0, ge=0, description="Number of pictures compared, evenly chosen of all.")
    psnr: Measured = Field(default=None, description="Mean over the pictures of the converted model, in dB.")
    ssim: Measured = Field(default=None, description="Mean over the pictures of the converted model.")
    psnr_before: Measured = Field(
        default=None, description="PSNR of the model itself on the same held-out photos, in dB."
    )


CONVERSION_HEADER = "Splatmill-Conversion"
"""Header of the renderer's response with a converted file: its `Conversion` as JSON."""

CONVERSION_VERSION = 2
"""To be raised when a converter writes other bytes than before."""


class ConversionRequest(Request):
    """The request to the renderer to convert a model."""

    format: str = Field(description="Key of the format, such as sog.")


class ModelDownload(Response):
    """A format in which the model can be downloaded."""

    format: str = Field(description="Key of the format: ply, compressed.ply, spz, sog, glb, ...")
    name: str = Field(description="What the format is called.")
    media_type: str
    loses: str = Field(description="What a model loses in it.")
    readers: list[str] = Field(description="Programs of others that read it.")
    address: str = Field(description="Address of the download, on the server's host.")
    bytes: int | None = Field(
        default=None, ge=0, description="Size of the file; null until the model has been converted."
    )
    conversion: Conversion | None = Field(
        default=None,
        description="What the conversion cost and lost; null until the model has been converted, and for model.ply.",
    )


class ModelDownloads(Response):
    """The formats in which a model can be downloaded."""

    formats: list[ModelDownload]
    psnr: Measured = Field(
        default=None, description="PSNR of the model on all of its held-out photos, in dB."
    )
