"""The configuration file: complete, exact, strict."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, fields, is_dataclass, replace

import pytest
import yaml

from zlocus.core.errors import ConfigError
from zlocus.core.options import OrientationOptions, RunConfig
from zlocus.core.options.option_fields import Checked, group, option
from zlocus.core.options.renamed_keys import REMOVED_KEYS, RENAMED_KEYS
from zlocus.io import config as config_io
from zlocus.io.config import config_as_dict, config_from_dict, read_config, write_config


@dataclass(frozen=True)
class Leaf(Checked):
    """Every kind of value."""

    number: float = option(0.1, "A number.", low=0.0, high=10.0, unit="m")
    count: int = option(3, "A count.", low=1)
    flag: bool = option(True, "A switch.")
    name: str = option("plain", "A word.", choices=("plain", 'quoted "one"\\'))
    limit: float | None = option(None, "A limit, unset by default.", high=5.0)
    sizes: tuple[int, ...] = option((1, 2), "Sizes.", unit="px")


@dataclass(frozen=True)
class Middle(Checked):
    """In between."""

    leaf: Leaf = group(Leaf, "Deep down.")


@dataclass(frozen=True)
class Root(Checked):
    """Nested twice."""

    middle: Middle = group(Middle, "In between.")
    leaf: Leaf = group(Leaf, "At the top.")
    scale: float = option(1.0, "Of its own.")


@pytest.fixture
def root(monkeypatch):
    """The reader and writer on a configuration with every kind of value."""
    monkeypatch.setattr(config_io, "RunConfig", Root)


def test_default_run_config_round_trips(tmp_path):
    (tmp_path / "c.toml").write_text(write_config(RunConfig()))
    assert read_config(tmp_path / "c.toml") == RunConfig()


@pytest.mark.usefixtures("root")
@pytest.mark.parametrize(
    "leaf",
    [
        Leaf(),
        Leaf(number=1e-7, count=10**12, flag=False, name='quoted "one"\\', limit=-2.5, sizes=(5,)),
        Leaf(number=1 / 3, limit=-1e22, sizes=()),
    ],
)
@pytest.mark.parametrize("form", ["toml", "yaml"])
def test_values_round_trip_exactly(tmp_path, leaf, form):
    config = Root(middle=Middle(leaf), leaf=replace(leaf, count=7), scale=0.1 + 0.2)
    text = write_config(config) if form == "toml" else yaml.safe_dump(config_as_dict(config))
    (tmp_path / f"c.{form}").write_text(text)
    assert read_config(tmp_path / f"c.{form}") == config


@pytest.mark.usefixtures("root")
def test_comments_say_what_in_which_unit_and_range():
    text = write_config(Root())
    assert "# A number. [0.0 to 10.0 m]\nnumber = 0.1\n" in text
    assert "# A count. [at least 1]\n" in text
    assert "# A limit, unset by default. [at most 5.0]\n# limit =   (unset)\n" in text
    assert "# Deep down.\n[middle.leaf]\n" in text


def test_every_option_is_in_the_file():
    def names(options, prefix=""):
        for f in fields(options):
            value = getattr(options, f.name)
            if is_dataclass(value):
                yield from names(value, f"{prefix}{f.name}.")
            else:
                yield f"{prefix}{f.name}"

    section, found = "", []
    for line in write_config(RunConfig()).splitlines():
        if match := re.fullmatch(r"\[(.+)\]", line):
            section = f"{match[1]}."
        elif match := re.match(r"(?:# )?(\w+) = ", line):
            found.append(section + match[1])
    assert sorted(found) == sorted(names(RunConfig()))


def test_dictionary_is_complete_and_builds_the_same():
    values = config_as_dict(RunConfig())
    assert values["orientation"]["model"] == "auto"
    assert config_from_dict(values, "run.json") == RunConfig()


def test_what_is_left_out_keeps_its_default():
    assert config_from_dict({"orientation": {"min_ties": 9}}, "f") == RunConfig(OrientationOptions(min_ties=9))


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"orientatoin": {}}, "orientatoin is not an option. Did you mean orientation?"),
        ({"orientation": {"inlier": 1.0}}, "orientation.inlier is not an option. Did you mean orientation.inlier_px?"),
        ({"orientation": {"qqqq": 1.0}}, "Known here: model, "),
        ({"orientation": 3}, "orientation must hold named options"),
        ({"orientation": {"inlier_px": "1"}}, "orientation.inlier_px = '1' is of the wrong type"),
        ({"orientation": {"inlier_px": True}}, "orientation.inlier_px = True is of the wrong type"),
        ({"orientation": {"min_ties": 12.5}}, "orientation.min_ties = 12.5 is of the wrong type"),
        ({"orientation": {"min_ties": None}}, "orientation.min_ties = None is of the wrong type"),
        ({"orientation": {"inlier_px": 99.0}}, "outside its range 0.1 to 10.0 px"),
        ({"orientation": {"inlier_px": float("nan")}}, "outside its range"),
        ({"orientation": {"model": "affine"}}, "is not one of auto, shift, joint, none"),
        ([1, 2], "must hold named options"),
    ],
)
def test_bad_values_are_refused_with_their_place(values, says):
    with pytest.raises(ConfigError) as caught:
        config_from_dict(values, "mine.toml")
    assert str(caught.value).startswith("mine.toml")
    assert says in str(caught.value)


@pytest.mark.usefixtures("root")
def test_unknown_keys_are_refused_at_every_level():
    with pytest.raises(ConfigError, match=r"middle\.leaf\.nmber is not an option\. Did you mean middle\.leaf\.number"):
        config_from_dict({"middle": {"leaf": {"nmber": 1.0}}}, "f")


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.toml", b"[orientation\n", "not a valid configuration file"),
        ("a.yaml", b"orientation: [\n", "cannot be read as YAML"),
        ("a.toml", b"\xff\xfe", "not text in UTF-8"),
        ("a.toml", b"[orientation]\nmin_ties = 3", "stops within line 2"),
        ("missing.toml", None, "cannot be read"),
        ("a.toml", b"[orientation]\nmodel = 2020-01-01\n", "wrong type"),
    ],
)
def test_broken_files(tmp_path, name, content, says):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigError, match=says) as caught:
        read_config(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_written_file_is_plain_toml():
    assert tomllib.loads(write_config(RunConfig()))["orientation"]["min_ties"] == RunConfig().orientation.min_ties


@pytest.mark.parametrize("old", sorted(RENAMED_KEYS))
def test_a_key_of_an_earlier_version_is_refused_with_its_new_name(tmp_path, old):
    *groups, name = old.split(".")
    (path := tmp_path / "c.toml").write_text(f"[{'.'.join(groups)}]\n{name} = 1\n" if groups else f"{name} = 1\n")
    with pytest.raises(ConfigError, match=re.escape(f"{old} is now called {RENAMED_KEYS[old]}.")):
        read_config(path)


@pytest.mark.parametrize("old", sorted(REMOVED_KEYS))
def test_a_key_that_is_gone_is_refused_with_what_applies(tmp_path, old):
    group_name, name = old.split(".")
    (path := tmp_path / "c.toml").write_text(f"[{group_name}]\n{name} = 1\n")
    with pytest.raises(ConfigError, match=re.escape(f"{old} is no longer an option; {REMOVED_KEYS[old]}. Remove it")):
        read_config(path)


def test_every_new_name_of_a_renamed_key_is_a_key():
    for new in RENAMED_KEYS.values():
        value = RunConfig()
        for name in new.split("."):
            value = getattr(value, name)
