"""Real frame images: their imported cameras, and the agreement of image pairs on an independent surface."""

from __future__ import annotations

import json
from itertools import combinations

import cv2
import numpy as np
import pytest
import rasterio
from pyproj import CRS, Transformer

from zlocus.core.options import RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import DsmRequest, ImportRequest
from zlocus.io.importers.scene import import_scene
from zlocus.io.scene_file import open_scene
from zlocus.pipeline.dsm import run_dsm

WINDOW = 9
LO25 = "+proj=tmerc +lat_0=0 +lon_0=25 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
# Rounding of the table: 0.5 mm and 0.0005 degrees in each of three.
TABLE_M, TABLE_DEG = 1e-3, 1e-3
# A pixel on the ground.
TERRAIN_M, MIN_COVERAGE = 5.8, 0.7


def ortho(view, xyz, shape):
    """Grey values at ground points, NaN outside of the image. xyz : (n, 3) -> shape."""
    xy = view.sensor.image_from_ground(xyz)
    rows, cols = view.image.shape
    pixels = view.image.read(0, 0, rows, cols).pixels
    inside = (xy > 0).all(axis=1) & (xy[:, 0] < cols - 1) & (xy[:, 1] < rows - 1)
    at = np.where(inside[:, None], xy, 0.0).astype(np.float32).reshape(*shape, 2)
    grey = cv2.remap(pixels, at, None, cv2.INTER_LINEAR)
    return np.where(inside.reshape(shape), grey, np.nan).astype(float)


def local_ncc(a, b):
    """Correlation in windows, NaN where one leaves its image."""

    def mean(v):
        return cv2.blur(v, (WINDOW, WINDOW), borderType=cv2.BORDER_CONSTANT)

    known = np.isfinite(a) & np.isfinite(b)
    whole = mean(known.astype(float)) > 0.999
    a, b = (np.where(known, v, 0.0) for v in (a, b))
    covariance = mean(a * b) - mean(a) * mean(b)
    spread = (mean(a * a) - mean(a) ** 2) * (mean(b * b) - mean(b) ** 2)
    return np.where(whole & (spread > 1e-3), covariance / np.sqrt(np.maximum(spread, 1e-3)), np.nan)


def agreement(views, xyz, shape, least=200):
    """Median correlation of the orthos of every pair that shares enough ground."""
    orthos = {view.name: ortho(view, xyz, shape) for view in views}
    found = {}
    for one, other in combinations(orthos, 2):
        ncc = local_ncc(orthos[one], orthos[other])
        if np.isfinite(ncc).sum() > least:
            found[one, other] = float(np.nanmedian(ncc))
    return found


def surface(path, step_m, window=None):
    """Points (n, 3) of a raster, resampled to a step, and the shape of their grid."""
    with rasterio.open(path) as source:
        z, transform = source.read(1).astype(np.float32), source.transform
        z[~np.isfinite(z) | (z == (source.nodata if source.nodata is not None else np.nan))] = np.nan
        xmin, ymin, xmax, ymax = window or source.bounds
    x, y = np.meshgrid(np.arange(xmin, xmax, step_m), np.arange(ymax, ymin, -step_m))
    col, row = ~transform * (x.ravel(), y.ravel())
    at = [np.asarray(v, np.float32).reshape(x.shape) - 0.5 for v in (col, row)]
    heights = cv2.remap(z, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
    return np.column_stack([x.ravel(), y.ravel(), heights.ravel()]), x.shape


@pytest.fixture(scope="module")
def tuniu(shared_data):
    return shared_data / "drone_tuniu_oblique"


def tuniu_offset(tuniu):
    """OpenDroneMap's map: the tangent frame's east and north, added to the reference's coordinates."""
    lla = json.loads((tuniu / "opensfm_reconstruction.json").read_text())[0]["reference_lla"]
    to_utm = Transformer.from_crs(4326, 32651, always_xy=True)
    return np.array([*to_utm.transform(lla["longitude"], lla["latitude"]), 0.0]), lla


def test_the_json_and_the_table_of_the_drone_agree(tuniu, tmp_path):
    """The table is the tangent frame put on the map as it is, without the convergence of 0.856 degrees."""
    camera = tmp_path / "camera.yaml"
    camera.write_text("focal: 911.72\n")
    request = ImportRequest("opensfm", tuniu, tmp_path / "local.yaml", local=True)
    local = {view.name: view.camera for view in import_scene(request).views}
    request = ImportRequest("eo", tuniu, tmp_path / "eo.yaml", crs="EPSG:32651", camera=camera, earth="flat")
    table = {view.name: view.camera for view in import_scene(request).views}
    true = {v.name: v.camera for v in import_scene(ImportRequest("opensfm", tuniu, tmp_path / "map.yaml")).views}
    offset, _ = tuniu_offset(tuniu)
    assert local.keys() == table.keys() == true.keys()
    for name, camera in local.items():
        np.testing.assert_allclose(np.array(camera.centre) + offset, table[name].centre, rtol=0, atol=TABLE_M)
        assert angle_deg(camera.rotation, table[name].rotation) < TABLE_DEG
        assert angle_deg(true[name].rotation, table[name].rotation) == pytest.approx(0.856, abs=2e-3)


def angle_deg(one, other):
    return np.rad2deg(np.arccos(np.clip((np.trace(np.array(one) @ np.array(other).T) - 1) / 2, -1, 1)))


@pytest.mark.parametrize("frame", ["local", "map"])
def test_drone_images_agree_on_the_surface(tuniu, tmp_path, frame):
    request = ImportRequest("opensfm", tuniu, tmp_path / "scene.yaml", local=frame == "local")
    import_scene(request)
    scene = open_scene([tmp_path / "scene.yaml"])
    offset, lla = tuniu_offset(tuniu)
    around = np.array([292_727.0, 2_731_063.0])
    xyz, shape = surface(tuniu / "reference/odm_dsm_0.8m.tif", 0.3, (*around - 70, *around + 70))
    for dz, low, high in ((0.0, 0.4, 1.0), (5.0, -0.2, 0.3)):
        points = xyz - offset + [0.0, 0.0, dz]
        if frame == "map":
            points = map_from_tangent(points, lla, scene.crs)
        found = agreement(scene.views, points, shape)
        assert len(found) == 5
        assert all(low < ncc < high for ncc in found.values())
        if not dz:
            assert found["100_0005_0142", "100_0005_0136"] > 0.85


def map_from_tangent(xyz, lla, crs):
    """PROJ's own chain of tangent frame, geocentric axes, map."""
    back = f"+proj=topocentric +ellps=WGS84 +lon_0={lla['longitude']} +lat_0={lla['latitude']} +h_0={lla['altitude']}"
    chain = f"+proj=pipeline +step +inv {back} +step +inv +proj=cart +ellps=WGS84 +step +proj=utm +zone=51 +ellps=WGS84"
    assert crs == CRS.from_epsg(32651)
    return np.column_stack(Transformer.from_pipeline(chain).transform(*xyz.T))


@pytest.mark.parametrize("earth", ["curved", "flat"])
def test_aerial_images_agree_on_the_terrain(shared_data, tmp_path, earth):
    folder = shared_data / "aerial_ngi_dmc"
    camera = tmp_path / "camera.yaml"
    camera.write_text("focal: 833.3333333333334   # 120 mm at 0.144 mm a pixel\n")
    out = tmp_path / "scene.yaml"
    import_scene(ImportRequest("eo", folder, out, crs=LO25, camera=camera, earth=earth))
    scene = open_scene([out])
    middle = np.array([-56_400.0, -3_729_500.0])
    xyz, shape = surface(folder / "reference/dem_24m_egm2008.tif", 6.0, (*middle - 2500, *middle + 2500))
    for dz, low, high in ((0.0, 0.7, 1.0), (100.0, -0.2, 0.3)):
        found = agreement(scene.views, xyz + np.array([0.0, 0.0, dz]), shape)
        assert len(found) >= 4
        assert all(low < ncc < high for ncc in found.values())


def test_a_surface_of_aerial_images_without_heights(shared_data, tmp_path):
    """Two images straight down, 5 km up; the terrain model is metres accurate, the pixel 5.8 m."""
    folder, out = shared_data / "aerial_ngi_dmc", tmp_path / "scene.yaml"
    camera = tmp_path / "camera.yaml"
    camera.write_text("focal: 833.3333333333334\n")
    import_scene(ImportRequest("eo", folder, out, crs=LO25, camera=camera))
    x, y = -56_400, -3_729_500
    bounds = (x - 600, y - 900, x + 600, y + 900)
    request = DsmRequest(inputs=(out,), out=tmp_path / "dsm", bounds=bounds, resolution=12.0, report=False)
    result = run_dsm(request, RunConfig(), SilentProgress())
    assert result.coverage > MIN_COVERAGE
    with rasterio.open(tmp_path / "dsm" / "dsm.tif") as source:
        found = source.read(1)
        col, row = np.meshgrid(np.arange(source.width), np.arange(source.height))
        x, y = source.transform * (col + 0.5, row + 0.5)
    with rasterio.open(folder / "reference/dem_24m_egm2008.tif") as source:
        terrain = np.array([v[0] for v in source.sample(np.column_stack([x.ravel(), y.ravel()]))], float)
    error = found.ravel() - terrain
    error = error[np.isfinite(error)]
    assert abs(np.median(error)) < TERRAIN_M
    assert np.median(np.abs(error - np.median(error))) < TERRAIN_M
