"""The training options: ranges, durations, sizes, and that the generated description says what the model enforces.

Does not prove that the trainer honours an option; that is shown where each is used.
"""

import json
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from splatmill.schema import (
    Job,
    Mapper,
    OptionHelp,
    TrainOptions,
    describe_options,
    format_bytes,
    format_duration,
    known_distance,
    parse_bytes,
    parse_duration,
)

OPTIONS = {option.name: option for option in describe_options()}
NUMERIC = [o for o in OPTIONS.values() if o.type in ("integer", "number", "duration", "bytes")]
CHOICES = [o for o in OPTIONS.values() if o.type == "choice"]


def test_every_field_is_described_once_with_help_and_group():
    assert list(OPTIONS) == list(TrainOptions.model_fields)
    for option in OPTIONS.values():
        assert option.help.endswith(".")
        assert option.group in {"budget", "photos", "cameras", "engine"}
        assert option.type in ("list", "text", "flag") or option.range_text, option.name


def test_description_survives_json():
    for option in OPTIONS.values():
        assert OptionHelp.model_validate(json.loads(option.model_dump_json())) == option


@pytest.mark.parametrize("option", NUMERIC, ids=lambda o: o.name)
def test_described_range_is_the_enforced_one(option: OptionHelp):
    step = 1 if option.type in ("integer", "bytes") else 1e-6
    assert option.minimum is not None
    assert option.maximum is not None
    for inside in (option.minimum, option.maximum):
        assert getattr(TrainOptions.model_validate({option.name: inside}), option.name) == inside
    for outside in (option.minimum - step, option.maximum + 1):
        with pytest.raises(ValidationError):
            TrainOptions.model_validate({option.name: outside})
    with pytest.raises(ValidationError):
        TrainOptions.model_validate({option.name: float("nan")})


@pytest.mark.parametrize("option", CHOICES, ids=lambda o: o.name)
def test_described_choices_are_the_enforced_ones(option: OptionHelp):
    assert option.choices is not None
    assert option.default in option.choices
    for choice in option.choices:
        assert getattr(TrainOptions.model_validate({option.name: choice}), option.name) == choice
    with pytest.raises(ValidationError):
        TrainOptions.model_validate({option.name: "nonsense"})


def test_defaults_are_the_described_ones():
    dumped = TrainOptions().model_dump(mode="json")
    assert dumped == {name: option.default for name, option in OPTIONS.items()}


def test_an_unknown_option_is_refused():
    with pytest.raises(ValidationError, match="stepps"):
        TrainOptions.model_validate({"stepps": 100})


def test_a_job_of_a_newer_server_is_read():
    job = Job.model_validate(
        {
            "id": "j",
            "capture": "c",
            "state": "queued",
            "created_at": "2026-01-01T00:00:00Z",
            "options": {"steps": 5, "invented_later": 1},
            "also_new": True,
        }
    )
    assert job.options.steps == 5


def test_global_is_spelt_as_on_the_wire():
    assert TrainOptions.model_validate({"mapper": "global"}).mapper is Mapper.global_
    assert TrainOptions.model_validate({"mapper": "global"}).model_dump(mode="json")["mapper"] == "global"


def test_photos_held_out_by_name_are_named_once():
    assert TrainOptions(test_views=("b.jpg", "a.jpg")).test_views == ("b.jpg", "a.jpg")
    with pytest.raises(ValidationError, match="named twice"):
        TrainOptions(test_views=("a.jpg", "a.jpg"))


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90s", 90), ("5m", 300), ("1h30m", 5400), ("1.5m", 90), ("2d", 172800), ("45", 45), (" 5 M ", 300)],
)
def test_durations(text: str, seconds: float):
    assert parse_duration(text) == seconds
    assert TrainOptions.model_validate({"time_budget": text}).time_budget == seconds


@pytest.mark.parametrize("text", ["", "m", "5x", "5m3", "-5m", "1e3", "nan", "inf", "٣s"])
def test_texts_that_are_no_duration(text: str):
    with pytest.raises(ValueError, match="not a duration"):
        parse_duration(text)


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("500MB", 5 * 10**8),
        ("1.5GB", 1_500_000_000),
        ("2GiB", 2**31),
        ("2 gib", 2**31),
        ("1234", 1234),
        ("1k", 1000),
    ],
)
def test_sizes(text: str, count: int):
    assert parse_bytes(text) == count


@pytest.mark.parametrize("text", ["", "GB", "5ib", "5XB", "-1GB", "1e9"])
def test_texts_that_are_no_size(text: str):
    with pytest.raises(ValueError, match="not a size"):
        parse_bytes(text)


@given(st.integers(0, 10**7))
def test_whole_seconds_read_as_they_are_written(seconds: int):
    assert parse_duration(f"{seconds}s") == parse_duration(str(seconds)) == seconds


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0.0s"), (9.96, "10s"), (59.6, "1m00s"), (65, "1m05s"), (7384, "2h03m")]
)
def test_shown_durations(seconds: float, text: str):
    assert format_duration(seconds) == text


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (1.5e6, "1.5 MB"), (2e12, "2.0 TB")]
)
def test_shown_sizes(count: float, text: str):
    assert format_bytes(count) == text


@pytest.mark.parametrize(
    ("text", "distance"),
    [
        ("a.jpg b.jpg 2.5m", ("a.jpg", "b.jpg", 2.5)),
        ("a.jpg b.jpg 25 cm", ("a.jpg", "b.jpg", 0.25)),
        ("'day one/a.jpg' b.jpg 10FT", ("day one/a.jpg", "b.jpg", pytest.approx(3.048))),
    ],
)
def test_known_distances(text: str, distance: object):
    assert known_distance(text) == distance
    assert TrainOptions(scale=text).scale == text


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a.jpg 2m", "is no distance between two photos"),
        ("a.jpg b.jpg c.jpg d.jpg 2m", "is no distance between two photos"),
        ("a.jpg b.jpg 2.5", "'2.5' is no length in mm, cm, m, km, in, ft"),
        ("a.jpg b.jpg 2 parsecs", "is no length"),
        ("a.jpg b.jpg 0m", "give one above zero"),
        ("a.jpg a.jpg 1m", "is named twice"),
        ("'a.jpg b.jpg 1m", "has an open quotation mark"),
        ("a.jpg b.jpg -1m", "is no length"),
    ],
)
def test_texts_that_are_no_distance(text: str, said: str):
    with pytest.raises(ValueError, match=re.escape(said)):
        TrainOptions(scale=text)
