"""The page of options: every field documented, in range, frozen."""

from __future__ import annotations

import typing
from dataclasses import FrozenInstanceError, dataclass, fields, is_dataclass

import pytest

from zlocus.core.errors import ConfigError
from zlocus.core.options import RunConfig
from zlocus.core.options.option_fields import Checked, option


def all_fields(options, prefix=""):
    """(name, field, value, type) of every option, however deep."""
    types = typing.get_type_hints(type(options))
    for f in fields(options):
        value = getattr(options, f.name)
        if is_dataclass(value):
            yield from all_fields(value, f"{prefix}{f.name}.")
        else:
            yield pytest.param(f, value, types[f.name], id=f"{prefix}{f.name}")


def all_groups(options):
    """Every options class and its fields."""
    yield options
    for f in fields(options):
        if is_dataclass(value := getattr(options, f.name)):
            yield from all_groups(value)


@pytest.mark.parametrize(("f", "value", "kind"), list(all_fields(RunConfig())))
def test_every_option_says_what_it_is(f, value, kind):
    doc = f.metadata["doc"]
    assert doc[0].isupper()
    assert doc.endswith(".")
    if value is None:
        assert type(None) in typing.get_args(kind)
    elif kind is float:
        assert type(value) is float
    is_number = kind in (int, float)
    has_range = any(f.metadata[limit] is not None for limit in ("low", "high", "choices"))
    assert has_range or not is_number, "a number without any limit"
    for suffix, unit in (("_px", "px"), ("_m", "m"), ("_gb", "GB"), ("_deg", "degrees")):
        assert not f.name.endswith(suffix) or f.metadata["unit"] == unit


@pytest.mark.parametrize(("f", "value", "kind"), list(all_fields(RunConfig())))
def test_an_option_that_can_be_unset_is_unset_by_default(f, value, kind):
    # TOML cannot write "unset" over another default.
    if type(None) in typing.get_args(kind):
        assert value is None


@pytest.mark.parametrize("options", list(all_groups(RunConfig())), ids=lambda o: type(o).__name__)
def test_groups_are_frozen_checked_and_documented(options):
    assert isinstance(options, Checked)
    assert type(options).__doc__
    assert all(f.metadata["doc"].endswith(".") for f in fields(options))
    with pytest.raises(FrozenInstanceError):
        setattr(options, fields(options)[0].name, None)


@dataclass(frozen=True)
class Sample(Checked):
    """For the checks."""

    size: float = option(1.0, "A size.", low=0.5, high=2.0, unit="m")
    kind: str = option("a", "A kind.", choices=("a", "b"))
    window: int = option(5, "A window.", choices=(5, 7))
    count: int | None = option(None, "A count.", low=1)
    weight: float = option(1.0, "A weight.", low=0.0)


@pytest.mark.parametrize("values", [{"size": 0.5}, {"size": 2.0}, {"kind": "b"}, {"count": 1}, {"count": None}])
def test_limits_are_inclusive(values):
    Sample(**values)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"size": 0.4}, r"Sample\.size = 0\.4 is outside its range 0\.5 to 2\.0 m\."),
        ({"size": 2.1}, r"Sample\.size = 2\.1"),
        ({"size": float("nan")}, r"Sample\.size = nan"),
        ({"kind": "c"}, r"Sample\.kind = 'c' is not one of a, b\."),
        ({"window": 6}, r"Sample\.window = 6 is not one of 5, 7\."),
        ({"weight": float("nan")}, r"Sample\.weight = nan"),
        ({"count": 0}, r"Sample\.count = 0 is outside its range 1 to inf"),
    ],
)
def test_values_out_of_range_are_refused(values, says):
    with pytest.raises(ConfigError, match=says):
        Sample(**values)
