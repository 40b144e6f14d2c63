"""The builds that are compared: what each changes in the engine, and the sources of it that see the change."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

STORAGE = Path(__file__).with_name("storage.hpp")

FLOAT32 = "Float32"
FORMS = ("project", "bin", "composite", "composite_forward", "composite_backward", "step")
"""Sources that see records, tiles and the cut."""


@dataclass(frozen=True)
class Variant:
    """One build of the kernels.

    name: also that of its folder.
    kind: what it changes, the same for those that are drawn alike.
    text: the change, in words.
    harmonics, first, second, record: formats of kernels/cpu/layout/storage.hpp and storage.hpp here, for SH
        coefficients, Adam's moments and projected records.
    constants: other compile definitions.
    sources: stems of the C++ files that see the change.
    """

    name: str
    kind: str
    text: str
    sources: tuple[str, ...] = ()
    harmonics: str = FLOAT32
    first: str = FLOAT32
    second: str = FLOAT32
    record: str | None = None
    constants: dict[str, str] = field(default_factory=dict)

    @property
    def definitions(self) -> tuple[str, ...]:
        """Its compile definitions, NAME=VALUE each; none where the engine is as it is shipped."""
        found = [f"{name}={value}" for name, value in self.constants.items()]
        if self.record or {self.harmonics, self.first, self.second} != {FLOAT32}:
            found += [f'SPLATMILL_STORAGE="{STORAGE}"', f"SPLATMILL_HARMONICS={self.harmonics}",
                      f"SPLATMILL_FIRST_MOMENT={self.first}", f"SPLATMILL_SECOND_MOMENT={self.second}"]  # fmt: skip
        if self.record:
            found.append(f"SPLATMILL_RECORD={self.record}")
        return tuple(found)


def cut(inverse: float) -> dict[str, str]:
    """The definitions that skip alphas below 1 / inverse."""
    return {
        "SPLATMILL_ALPHA_MIN": f"{1 / inverse!r}f",
        "SPLATMILL_LOG2_ALPHA_MIN": f"{-math.log2(inverse)!r}f",
    }


def end(transmittance: str) -> dict[str, str]:
    """The definition that ends a pixel at a transmittance."""
    return {"SPLATMILL_TRANSMITTANCE_MIN": f"{transmittance}f"}


PLAIN = Variant("float32", "shipped", "float32, tiles of 16, cut at 1/255, end at 1e-4")
EXACT = Variant(
    "exact", "reference", "cut at 2^-20, end at 1e-9: what the others are compared with", FORMS,
    constants=cut(2.0**20) | end("1e-9"),
)  # fmt: skip

VARIANTS = (
    PLAIN,
    Variant("records_fp16", "records", "records in fp16, centres in float32", FORMS, record="Float16"),
    Variant("records_bf16", "records", "records in bf16, centres in float32", FORMS, record="BFloat16"),
    Variant("sh_fp16", "harmonics", "SH coefficients in fp16, rounded stochastically", ("project", "step"),
            harmonics="Float16Stochastic"),
    Variant("sh_bf16", "harmonics", "SH coefficients in bf16, rounded stochastically", ("project", "step"),
            harmonics="BFloat16Stochastic"),
    Variant("moments_nearest", "moments", "both moments in bf16, rounded to nearest", ("step",),
            first="BFloat16", second="BFloat16"),
    Variant("moments_stochastic", "moments", "both moments in bf16, the second rounded stochastically", ("step",),
            first="BFloat16", second="BFloat16Stochastic"),
    Variant("moments_compensated", "moments", "both moments in bf16, the second with 8 bits of its rounding error",
            ("step",), first="BFloat16", second="BFloat16Compensated"),
    Variant("first_moment", "moments", "the first moment in bf16, rounded to nearest", ("step",), first="BFloat16"),
    Variant("tile_8", "tile", "tiles of 8", FORMS, constants={"SPLATMILL_TILE": "8"}),
    Variant("cut_64", "cut", "cut at 1/64", FORMS, constants=cut(64)),
    Variant("cut_128", "cut", "cut at 1/128", FORMS, constants=cut(128)),
    Variant("cut_512", "cut", "cut at 1/512", FORMS, constants=cut(512)),
    Variant("end_1e-3", "end", "end at 1e-3", ("composite_forward",), constants=end("1e-3")),
    Variant("end_1e-2", "end", "end at 1e-2", ("composite_forward",), constants=end("1e-2")),
)  # fmt: skip
BY_NAME = {v.name: v for v in (*VARIANTS, EXACT)}
