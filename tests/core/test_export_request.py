"""Requests of an export: options that say nothing to a format are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from zlocus.core.errors import ConfigError
from zlocus.core.export_request import EXPORT_FORMATS, ExportRequest

GIVEN = {
    "crs": "EPSG:32632", "bounds": (0.0, 0.0, 1.0, 1.0), "heights": (0.0, 9.0), "max_error": 2.0, "points": False,
    "resolution": 1.0, "jump": 3.0,
}  # fmt: skip


@pytest.mark.parametrize("kind", EXPORT_FORMATS)
@pytest.mark.parametrize("name", GIVEN)
def test_options_belong_to_formats(kind, name):
    def request():
        return ExportRequest(kind, (Path("a"),), Path("out"), **{name: GIVEN[name]})

    if name in EXPORT_FORMATS[kind]:
        assert getattr(request(), name) == GIVEN[name]
    else:
        with pytest.raises(ConfigError, match=f"--{name.replace('_', '-')} says nothing"):
            request()


@pytest.mark.parametrize(("kind", "options", "said"), [
    ("obj", {}, "no format of an export"),
    ("rpc", {"max_error": 0.0}, "--max-error 0 is not a size"),
    ("nerf", {"heights": (3.0, 3.0)}, "empty range"),
    ("nerf", {"bounds": (3.0, 3.0, 1.0, 4.0)}, "holds no area"),
    ("mesh", {"jump": -1.0}, "--jump -1 is not a size"),
    ("mesh", {"resolution": float("nan")}, "--resolution nan is not a size"),
])  # fmt: skip
def test_wrong_values_are_refused(kind, options, said):
    with pytest.raises(ConfigError, match=said):
        ExportRequest(kind, (Path("a"),), Path("out"), **options)


def test_nothing_is_no_input():
    with pytest.raises(ConfigError, match="Nothing is given"):
        ExportRequest("rpc", (), Path("out"))
