"""Options of --set, in place of those of a file."""

from __future__ import annotations

import pytest

from zlocus.core.errors import ConfigError
from zlocus.core.options import RunConfig
from zlocus.io.settings import config_with_settings


def test_settings_of_every_kind():
    config = config_with_settings(
        None, ["selection.order=labels", "pyramid.tile=512", "semiglobal.p1=40", 'products.ortho_levels="common"']
    )
    assert (config.selection.order, config.pyramid.tile, config.semiglobal.p1, config.products.ortho_levels) == (
        "labels",
        512,
        40,
        "common",
    )


def test_a_setting_replaces_the_file_and_an_empty_one_restores_the_default(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[pyramid]\ntile = 256\n[semiglobal]\np1 = 30\n")
    assert config_with_settings(path, ["pyramid.tile = 512"]).pyramid.tile == 512
    assert config_with_settings(path, ["pyramid.tile=512", "pyramid.tile=384"]).pyramid.tile == 384
    config = config_with_settings(path, ["pyramid.tile=", "semiglobal.p1="])
    assert config == RunConfig()


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("pyramid.tile", "--set pyramid.tile is no setting"),
        ("=3", "--set =3 is no setting"),
        ("pyramid.tyle=3", "--set pyramid.tyle=3: pyramid.tyle is not an option. Did you mean pyramid.tile?"),
        ("pyramid=3", "--set pyramid=3: pyramid must hold named options"),
        (
            "pyramid.tile=many",
            "--set pyramid.tile=many: pyramid.tile = 'many' is of the wrong type: a whole number is needed.",
        ),
        ("pyramid.tile=3\nx=4", "is of the wrong type"),
        ("selection.order=no", "--set selection.order=no: "),
    ],
)
def test_settings_that_cannot_be_used(setting, says):
    with pytest.raises(ConfigError) as caught:
        config_with_settings(None, [setting])
    assert says in str(caught.value)


def test_the_fault_of_a_file_is_told_with_its_name(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[pyramid]\ntyle = 256\n")
    with pytest.raises(ConfigError, match=r"mine\.toml: pyramid\.tyle is not an option"):
        config_with_settings(path, ["pyramid.tile=512"])
