"""The settings of a training, from `splatmill.schema.describe_options()`."""

from itertools import groupby

from docs.generate.markdown import choices, code, table

from splatmill.cli.schema_options import PANELS
from splatmill.schema import (
    PRESET_GAIN,
    PRESET_STEPS,
    PRESET_VISITS,
    FitImageOptions,
    OptionHelp,
    Preset,
    describe_options,
    format_bytes,
)
from splatmill_worker.splat.plan.photos import PRESET_SIZE

INTRODUCTION = """# Settings

Every setting of a training, generated from the program. A setting has one name everywhere: `time_budget` is
`--time-budget` on the command line, `time_budget=` in the SDK, and `"time_budget"` among the `options` of a job in the
REST API. `splatmill options` prints the same list, and `GET /v1/options` returns it as JSON.

No setting is required. A setting without a default is either not used unless it is given (a time budget, a target), or
decided from the photos (the image size, the degree of the spherical harmonics); the plan in the [report](../report.md)
names each decision and the fact behind it.

A duration is written as `90s`, `5m`, `1h30m` or a number of seconds; a size in bytes as `500MB`, `1.5GB`, `2GiB` or a
number of bytes.
"""

PRESETS = """(presets)=
### Presets

What a preset decides, where no other setting does. Training ends once the last doubling of its steps has raised the
PSNR of [validation photos](../report.md#validation-photos) by less than the gain. It is laid out for the number of
steps, or for the steps for each photo where these are more. Where the last doubling gained as much as the gain, these
are doubled, twice at most. Captures of fewer than twelve photos spare none to judge by, and keep to the steps. The last
columns are the longest side of the photos in pixels on each backend.
"""

FIT_IMAGE = """## Fitting one picture

The settings of `splatmill fit-image`, which fits a single picture by Gaussians in a plane.
"""


def page() -> str:
    """The page of settings."""
    parts = [INTRODUCTION]
    for group, options in groupby(describe_options(), key=lambda option: option.group):
        parts += [f"## {PANELS[group]}\n", _table(list(options))]
        parts += [PRESETS, _presets()] if group == "budget" else []
    parts += [FIT_IMAGE, _table(describe_options(FitImageOptions))]
    return "\n".join(parts)


def _presets() -> str:
    rows = [
        [
            code(preset.value),
            f"{PRESET_GAIN[preset]:g} dB",
            f"{PRESET_STEPS[preset]:,}",
            str(PRESET_VISITS[preset]),
            *(f"{size[preset]:,}" for size in PRESET_SIZE.values()),
        ]
        for preset in Preset
    ]
    return table(
        ["preset", "gain", "steps", "steps for each photo", *(code(backend) for backend in PRESET_SIZE)], rows
    )


def _table(options: list[OptionHelp]) -> str:
    rows = [[code(option.name), _values(option), _default(option), option.help] for option in options]
    return table(["setting", "values", "default", "meaning"], rows)


def _values(option: OptionHelp) -> str:
    if option.choices:
        return choices(option.choices)
    if option.type == "flag":
        return "on or off"
    if option.minimum is None or option.maximum is None or option.type == "list":
        return option.type
    show = {"duration": "{:,.0f} s".format, "bytes": format_bytes}.get(option.type, "{:,}".format)
    return f"{option.type}, {show(option.minimum)} to {show(option.maximum)}"


def _default(option: OptionHelp) -> str:
    if option.default is None:
        return ""
    return "off" if option.default is False else code(option.default)
