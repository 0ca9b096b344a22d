"""A surface by window: heights, means, the greatest height within bounds, and what is no surface."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from affine import Affine
from odc.geo.geobox import GeoBox

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.scene import is_local
from zlocus.io.crs import local_frame
from zlocus.io.surface_heights import open_surface

AT = Affine(2.0, 0.0, 462000.0, 0.0, -2.0, 5247000.0)


def written(path, z, transform=AT, crs="EPSG:32632"):
    with rasterio.open(
        path, "w", driver="GTiff", height=z.shape[0], width=z.shape[1], count=1, dtype="float32", crs=crs,
        transform=transform, nodata=np.nan,
    ) as file:  # fmt: skip
        file.write(z.astype(np.float32), 1)
    return path


@pytest.fixture
def surface(tmp_path):
    z = np.full((600, 700), 400.0)
    z[300, 650] = 460.0
    z[:50, :50] = np.nan
    return open_surface(written(tmp_path / "surface.tif", z))


def test_the_greatest_height_is_never_missed(surface):
    assert surface.z_range == (400.0, 460.0)
    assert surface.highest_in((-np.inf, -np.inf, np.inf, np.inf)) == 460.0
    tower = AT.c + 2 * 650.5, AT.f - 2 * 300.5
    assert surface.highest_in((tower[0] - 5, tower[1] - 5, tower[0] + 5, tower[1] + 5)) == 460.0
    assert surface.highest_in((AT.c, AT.f - 100, AT.c + 100, AT.f)) == 400.0
    assert surface.highest_in((AT.c - 900, AT.f, AT.c - 800, AT.f + 100)) == 400.0


def test_windows_hold_the_heights(surface):
    west, north = AT.c + 2 * 640, AT.f - 2 * 290
    z = surface.read(GeoBox((40, 40), Affine(1.0, 0.0, west, 0.0, -1.0, north), "EPSG:32632"))
    assert z.max() == pytest.approx(400.0 + 60.0 * 0.75**2, abs=0.01)
    assert np.isfinite(z).all()
    gap = surface.read(GeoBox((10, 10), Affine(2.0, 0.0, AT.c, 0.0, -2.0, AT.f), "EPSG:32632"))
    assert np.isnan(gap).all()


def test_a_local_frame_is_taken_where_it_may_be(tmp_path):
    path = written(tmp_path / "local.tif", np.full((30, 40), 7.0), AT, local_frame().to_wkt())
    with pytest.raises(InputError, match="cannot be converted to places on the Earth"):
        open_surface(path)
    surface = open_surface(path, may_be_local=True)
    assert is_local(surface.crs)
    assert (
        surface.read(GeoBox(surface.shape, surface.transform, surface.crs)).tolist() == np.full((30, 40), 7.0).tolist()
    )


def test_what_is_no_surface_is_refused(tmp_path):
    z = np.full((20, 20), np.nan)
    with pytest.raises(InputError, match="no height in any cell"):
        open_surface(written(tmp_path / "empty.tif", z))
    with pytest.raises(ConfigError, match="projected"):
        open_surface(written(tmp_path / "degrees.tif", z, Affine(1e-5, 0, 11.0, 0, -1e-5, 47.0), "EPSG:4326"))
    with pytest.raises(ConfigError, match="north up"):
        open_surface(written(tmp_path / "oblong.tif", z, Affine(2.0, 0, 462000.0, 0, -3.0, 5247000.0)))
