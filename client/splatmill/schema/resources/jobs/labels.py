"""Labels by which people find a job and its model again: the name, the tags and the star, and orders of lists."""

from enum import StrEnum
from typing import Annotated, Self

from pydantic import AfterValidator, Field, StringConstraints, model_validator

from splatmill.schema.base import Label, Request, without_controls

MOST_TAGS = 12


class ListOrder(StrEnum):
    """The order of a list of jobs or models: the newest, the name, the largest model or the highest PSNR first."""

    newest = "newest"
    name = "name"
    size = "size"
    psnr = "psnr"


def _without_commas(tag: str) -> str:
    if "," in tag:
        raise ValueError("a tag has no comma, which separates tags where people type them")
    return tag


def _each_once(tags: list[str]) -> list[str]:
    first: dict[str, str] = {}
    for tag in tags:
        first.setdefault(tag.casefold(), tag)
    return list(first.values())


Tag = Annotated[
    str,
    StringConstraints(strip_whitespace=True, min_length=1, max_length=40),
    AfterValidator(without_controls),
    AfterValidator(_without_commas),
]
"""A word, or a few, that several records have in common."""

Tags = Annotated[list[Tag], Field(max_length=MOST_TAGS), AfterValidator(_each_once)]


class ChangeLabels(Request):
    """Changes the labels of a job and its model. Fields that are left out stay as they are; one must be given."""

    name: Label | None = Field(default=None, description="A name to recognise it by; null for none.")
    tags: Tags = Field(
        default_factory=list,
        description="Its tags, in place of those that it has. Of tags that differ in case alone, the first counts.",
    )
    favourite: bool = Field(default=False, description="Whether it has a star.")

    @model_validator(mode="after")
    def _changes_something(self) -> Self:
        if not self.model_fields_set:
            raise ValueError("Nothing would change: give name, tags or favourite.")
        return self
