"""Points as a reference: CRS and vertical datums are brought to those of the surface, or refused."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.transform import from_origin

from evaluation_rasters import CRS, NORTH, WEST, moved, write
from point_files import cloud, csv, gpkg
from zlocus.core.errors import ConfigError, InputError
from zlocus.evaluation.height_file import HeightFile
from zlocus.evaluation.point_reference import PointReference
from zlocus.io.points.ground_points import KnownPoints, PointOptions
from zlocus.io.vertical import ELLIPSOIDAL_DESCRIPTION

UNDULATION_M = 47.5
XYZ = np.array([[WEST + 20, NORTH - 30, 100.0], [WEST + 40, NORTH - 10, 110.0]])
# Degrees are written with 9 digits behind the point, 0.1 mm.
DEGREES_M = 2e-4


@pytest.fixture
def dsm(tmp_path):
    return moved(tmp_path / "d.tif", 120, (0, 0, 0))


@pytest.fixture
def geoid(tmp_path):
    z = np.full((30, 30), UNDULATION_M, np.float32)
    return write(tmp_path / "geoid.tif", z, from_origin(8.0, 48.0, 0.1, 0.1), "EPSG:4326")


def described(path, crs=CRS, description=""):
    """The same raster with a CRS, and a description of its band."""
    with rasterio.open(path) as file:
        z, transform = file.read(1), file.transform
    write(path, z, transform, crs)
    with rasterio.open(path, "r+") as file:
        file.set_band_description(1, description)
    return path


def opened(dsm, path, options=None, geoid=None):
    return PointReference.open(HeightFile.open(dsm), (path,), options or PointOptions(), geoid)


def points_of(reference):
    return KnownPoints.joined(list(reference.chunks())).xyz


def degrees(folder, xyz=XYZ):
    lon, lat = Transformer.from_crs(CRS, 4326, always_xy=True).transform(xyz[:, 0], xyz[:, 1])
    columns = {"Longitude": [f"{x:.9f}" for x in lon], "Latitude": [f"{y:.9f}" for y in lat], "height": xyz[:, 2]}
    return csv(folder / "deg.csv", columns)


def test_points_of_other_crs_are_converted(tmp_path, dsm):
    assert points_of(opened(dsm, degrees(tmp_path))) == pytest.approx(XYZ, abs=DEGREES_M)
    x, y = Transformer.from_crs(CRS, 3857, always_xy=True).transform(XYZ[:, 0], XYZ[:, 1])
    path = gpkg(tmp_path / "p.gpkg", np.column_stack([x, y, XYZ[:, 2]]), crs="EPSG:3857")
    assert points_of(opened(dsm, path)) == pytest.approx(XYZ, abs=DEGREES_M)


def test_points_without_crs_are_taken_to_be_in_that_of_the_surface_and_it_is_said(tmp_path, dsm):
    reference = opened(dsm, csv(tmp_path / "p.csv", dict(zip("xyz", XYZ.T, strict=True))))
    assert points_of(reference).tolist() == XYZ.tolist()
    (sentence,) = reference.assumed
    assert sentence.endswith("p.csv has no CRS: its coordinates are taken to be in that of the surface (EPSG:32632)")


def test_points_outside_are_counted_and_none_inside_is_refused(tmp_path, dsm):
    far = np.vstack([XYZ, XYZ[0] + np.array([5000, 0, 0])])
    reference = opened(dsm, csv(tmp_path / "p.csv", dict(zip("xyz", far.T, strict=True))))
    assert len(points_of(reference)) == 2
    assert reference.dropped == {"outside of the surface": 1}
    path = csv(tmp_path / "far.csv", dict(zip("xyz", far[2:].T, strict=True)))
    with pytest.raises(InputError, match=r"No point of .*far.csv lies in .*d.tif: they lie between 505020 and 505020"):
        points_of(opened(dsm, path))
    with pytest.raises(InputError, match="Check the CRS of both"):
        points_of(opened(dsm, csv(tmp_path / "p.csv", {"lon": [8], "lat": [47], "z": [1]})))
    with pytest.raises(InputError, match=r"No point of .*far.laz lies in"):
        points_of(opened(dsm, cloud(tmp_path / "far.laz", far[2:])))


def test_heights_above_a_geoid_are_converted(tmp_path, dsm, geoid):
    described(dsm, description=ELLIPSOIDAL_DESCRIPTION)
    table = csv(tmp_path / "p.csv", dict(zip("xyz", XYZ.T, strict=True)))
    raised = XYZ + np.array([0, 0, UNDULATION_M])
    assert points_of(opened(dsm, table, geoid=geoid)) == pytest.approx(raised, abs=1e-4)
    options = PointOptions(vertical=str(geoid))
    reference = opened(dsm, table, options)
    assert points_of(reference) == pytest.approx(raised, abs=1e-4)
    assert reference.geoid_added_to == table
    assert points_of(opened(dsm, table, PointOptions(vertical="ellipsoid"))).tolist() == XYZ.tolist()


def test_a_surface_above_a_geoid_meets_ellipsoidal_points(tmp_path, dsm, geoid):
    described(dsm, crs="EPSG:32632+5773")
    table = degrees(tmp_path)
    with pytest.raises(InputError, match=r"EGM96 height and those of .* above the ellipsoid. Add the geoid's heights"):
        opened(dsm, table, PointOptions(crs="EPSG:4979"))
    reference = opened(dsm, table, PointOptions(crs="EPSG:4979"), geoid)
    assert points_of(reference) == pytest.approx(XYZ - np.array([0, 0, UNDULATION_M]), abs=1e-3)
    assert reference.geoid_added_to == dsm
    same = opened(dsm, table, PointOptions(crs="EPSG:4326+5773"))
    assert points_of(same) == pytest.approx(XYZ, abs=DEGREES_M)
    with pytest.raises(ConfigError, match="is not needed"):
        opened(dsm, table, PointOptions(crs="EPSG:4326+5773"), geoid)


def test_heights_in_feet_and_unknown_crs_are_refused(tmp_path, dsm):
    table = degrees(tmp_path)
    with pytest.raises(InputError, match=r"in US survey foot. Convert them to metres"):
        opened(dsm, table, PointOptions(crs="EPSG:4269+6360"))
    with pytest.raises(ConfigError, match="--points-crs nowhere is no CRS that PROJ knows"):
        PointOptions(crs="nowhere")
    for options, sentence in (
        ({"returns": "second"}, "--returns second is not known"), ({"sigma_m": 0.0}, "--points-sigma 0 is not a size"),
        ({"columns": {"up": "z"}}, "--columns up=... is no column"), ({"laser_classes": (300,)}, "--laser-classes 300"),
        ({"vertical": "sea"}, "--points-vertical sea is neither"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=sentence):
            PointOptions(**options)


def test_a_surface_without_crs_takes_coordinates_as_they_are(tmp_path):
    dsm = moved(tmp_path / "d.tif", 120, (0, 0, 0))
    described(dsm, crs=None)
    reference = opened(dsm, gpkg(tmp_path / "p.gpkg", XYZ))
    assert points_of(reference).tolist() == XYZ.tolist()
    assert reference.assumed == (f"{dsm} has no CRS: coordinates are compared as they are",)
    with pytest.raises(InputError, match=r"has longitudes and latitudes, and .* has no CRS"):
        opened(dsm, degrees(tmp_path))
