"""Finished surfaces as inputs: what is read, what fits together, and what is refused."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from affine import Affine

from geoids import write_geoid
from overlapping_surfaces import CORNER, write_raster, write_run
from zlocus.core.errors import ConfigError, InputError
from zlocus.io.surface_inputs import SIGMA, check_joinable, check_not_inputs, converted_datums, surface_input
from zlocus.io.vertical import ELLIPSOID, ELLIPSOIDAL_DESCRIPTION

Z = np.full((20, 30), 10.0, np.float32)


def raster(tmp_path, name="a.tif", transform=CORNER, crs="EPSG:32632", **more):
    return write_raster(tmp_path / name, Z, transform, crs, **more)


def test_the_folder_of_a_run(tmp_path):
    folder = write_run(tmp_path / "run", Z, Z / 50, quality=np.zeros(Z.shape, np.uint16))
    (folder / "run.json").write_text(json.dumps({"inputs": [{"path": "a.tif", "sha256": "ab"}, {"path": "b"}]}))
    surface = surface_input(folder)
    assert set(surface.layers) == {SIGMA, "quality.tif"}
    assert surface.datum == ELLIPSOID
    assert surface.images == {"ab"}
    assert surface.has_sigma
    assert surface.cell == 0.5


def test_a_raster_with_and_without_a_standard_deviation(tmp_path):
    path, sigma = raster(tmp_path), raster(tmp_path, "s.tif")
    assert not surface_input(path).has_sigma
    assert surface_input(f"{path}=0.25").sigma_m == 0.25
    assert surface_input(f"{path}={sigma}").layers[SIGMA] == sigma
    named = raster(tmp_path, "odd=name.tif")
    assert surface_input(named).dsm == named


@pytest.mark.parametrize(("sigma", "said"), [("-1", "is no standard deviation"), ("none.tif", "There is no raster of")])
def test_a_wrong_standard_deviation(tmp_path, sigma, said):
    with pytest.raises((ConfigError, InputError), match=said):
        surface_input(f"{raster(tmp_path)}={sigma}")
    with pytest.raises(ConfigError, match="is a folder with standard deviations of its own"):
        surface_input(f"{tmp_path}=0.1")


def test_a_standard_deviation_on_another_grid_is_refused(tmp_path):
    other = raster(tmp_path, "s.tif", CORNER * Affine.translation(1, 0))
    with pytest.raises(InputError, match=r"is not on the grid of"):
        surface_input(f"{raster(tmp_path)}={other}")


def test_what_is_no_surface(tmp_path):
    with pytest.raises(InputError, match="There is no surface"):
        surface_input(tmp_path / "none.tif")
    with pytest.raises(InputError, match="holds no run"):
        surface_input(tmp_path)
    with pytest.raises(InputError, match=r"are in feet|in ft"):
        surface_input(write_feet(tmp_path))


def write_feet(tmp_path):
    import rasterio

    path = raster(tmp_path, "feet.tif")
    with rasterio.open(path, "r+") as file:
        file.units = ("ft",)
    return path


@pytest.mark.parametrize(
    ("first", "second", "said"),
    [
        ({"transform": Affine(0.5, 0.1, 4e5, 0.1, -0.5, 5e6)}, {}, "is rotated or not north-up"),
        ({"crs": "EPSG:4326", "transform": Affine(1e-5, 0, 8, 0, -1e-5, 45)}, {}, "not in metres"),
        ({"crs": None}, {}, "has no CRS, and the others have one"),
        ({"description": ELLIPSOIDAL_DESCRIPTION}, {"crs": "EPSG:25832+7837"}, "has no geoid between them"),
    ],
)
def test_surfaces_that_do_not_fit_together(tmp_path, first, second, said):
    both = [surface_input(raster(tmp_path, "a.tif", **first)), surface_input(raster(tmp_path, "b.tif", **second))]
    with pytest.raises(InputError, match=said):
        check_joinable(both)


def test_what_has_to_be_assumed_is_said(tmp_path):
    silent, ellipsoidal = surface_input(raster(tmp_path)), surface_input(write_run(tmp_path / "run", Z, Z))
    for both in ((silent, ellipsoidal), (ellipsoidal, silent)):
        (sentence,) = check_joinable(both)
        assert sentence == f"{silent.path} does not state its vertical datum: taken to be the ellipsoid."
    assert check_joinable([silent, silent]) == []


def test_heights_above_a_geoid_are_converted(tmp_path):
    geoid = write_geoid(
        tmp_path / "geoid.tif", np.full((8, 8), 47.0, np.float32), Affine(0.25, 0, 7.0, 0, -0.25, 46.0)
    )  # fmt: skip
    ellipsoidal = surface_input(write_run(tmp_path / "run", Z, Z))
    above = surface_input(raster(tmp_path, crs="EPSG:32632+5773"))
    (sentence,) = check_joinable([ellipsoidal, above], geoid)
    assert "are converted to the ellipsoid" in sentence
    given, wanted = converted_datums(ellipsoidal, above, geoid)
    moved = wanted.heights_from_ellipsoidal(given.ellipsoidal_from_heights(Z, above.geobox), above.geobox)
    assert np.allclose(moved, 57.0)
    with pytest.raises(ConfigError, match="is not needed"):
        check_joinable([ellipsoidal, ellipsoidal], geoid)
    assert math.isfinite(moved[0, 0])


def test_inputs_are_not_written_over(tmp_path):
    surface = surface_input(write_run(tmp_path / "run", Z, Z))
    with pytest.raises(ConfigError, match="might be written over"):
        check_not_inputs(tmp_path / "run", [surface])
