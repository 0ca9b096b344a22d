"""`zlocus align`: the whole folder moves together, and run.json states by how much and how well that is known."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest
import rasterio

from evaluation_rasters import CRS, NORTH, WEST, grid, rolling, write
from point_files import cloud, csv, gpkg
from point_scenes import PLANTED, N, ground_points, table, tilted
from surface_folders import TRANSFORM, surface_folder
from zlocus.core.align_request import AlignRequest
from zlocus.core.errors import ConfigError, InputError, OutputError
from zlocus.core.progress import SilentProgress
from zlocus.evaluation import fit_sample
from zlocus.evaluation.height_file import HeightFile
from zlocus.io.points.ground_points import PointOptions
from zlocus.io.styles.file_names import OF_SURFACE, style_files
from zlocus.pipeline.align import run_align
from zlocus.products.derived import FILES

# The bars of the issue: a shift to 1 cm, a tilt to 0.01 m over the scene.
SHIFT_M, TILT_M = 0.01, 0.01
# Heights of float32 around 100 m.
ROUNDED_M = 2e-5
# Heights between cells of 0.5 m, interpolated twice.
INTERPOLATED_M = 0.005
RASTERS = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif")


def heights(planted=PLANTED, tilt=(0.0, 0.0)):
    """Heights of the ground seen by a surface that lies `planted` beside it, on the grid of `surface_folder`."""
    x, y = grid(N)
    return tilted(rolling(x - planted[0], y + planted[1]) + planted[2], *tilt)


@pytest.fixture
def folder(tmp_path):
    z = heights()
    z[40:60, 300:330] = np.nan
    is_filled = np.zeros(z.shape, bool)
    is_filled[120:360] = True  # most of it
    return surface_folder(tmp_path / "surface", z + 9.0 * is_filled, is_filled=is_filled)


@pytest.fixture(autouse=True)
def few_places(monkeypatch):
    monkeypatch.setattr(fit_sample, "MAX_POINTS", 20_000)


def aligned(surface, reference, out, points=None, **options):
    request = AlignRequest(surface, (reference,) if not isinstance(reference, tuple) else reference, out, **options)
    return run_align(request, points or PointOptions(), SilentProgress())


def read(path):
    with rasterio.open(path) as file:
        return file.read(), file.transform, file.profile, file.tags(1), file.dataset_mask()


def errors_at(dsm, xyz):
    return HeightFile.open(dsm).bilinear(xyz[:, :2]) - xyz[:, 2]


def test_a_folder_moves_as_one_and_nothing_is_interpolated(tmp_path, folder):
    (folder / FILES["hillshade"]).touch()
    out = tmp_path / "aligned"
    result = aligned(folder, table(tmp_path), out)
    assert result.fit.shift_m == pytest.approx(PLANTED, abs=SHIFT_M)
    east, north, up = result.fit.shift_m
    rasters = (*RASTERS, "hillshade.tif")
    styles = [name for raster in rasters if raster in OF_SURFACE for name in style_files(raster)]
    assert sorted(path.name for path in out.iterdir()) == sorted([*rasters, *styles, "item.json", "run.json"])
    for name in RASTERS:
        values, transform, profile, tags, mask = read(out / name)
        before, was, profile_before, tags_before, mask_before = read(folder / name)
        assert (transform.c, transform.f) == pytest.approx((was.c - east, was.f - north), abs=1e-6)
        expected = before - up if name == "dsm.tif" else before
        np.testing.assert_allclose(values, expected, atol=ROUNDED_M if name == "dsm.tif" else 0, rtol=0)
        for key in ("dtype", "nodata", "count", "photometric", "crs"):
            np.testing.assert_equal(profile.get(key), profile_before.get(key))
        np.testing.assert_array_equal(mask, mask_before)
        assert {k: v for k, v in tags.items() if "STAT" not in k} == {
            k: v for k, v in tags_before.items() if "STAT" not in k
        }
    off = errors_at(out / "dsm.tif", ground_points(500, seed=5, rim_m=20))
    # Filled cells are 9 m too high, and are not what the surface was fitted by.
    assert abs(np.median(off[off < 4])) < 0.002


def test_run_json_states_the_offset_and_where_it_comes_from(tmp_path, folder):
    points = table(tmp_path, sigma=[0.02] * 1500)
    aligned(folder, points, tmp_path / "aligned")
    run = json.loads((tmp_path / "aligned" / "run.json").read_text())
    alignment = run["alignment"]
    assert alignment["offset_m"] == pytest.approx(dict(zip(("east", "north", "up"), PLANTED, strict=True)), abs=SHIFT_M)
    assert all(0 < sigma < SHIFT_M for sigma in alignment["sigma_m"].values())
    assert alignment["before"]["rmse"] > 0.5 > 0.05 > alignment["after"]["rmse"]
    assert alignment["inputs"][1]["sha256"] == hashlib.sha256(points.read_bytes()).hexdigest()
    assert alignment["surface"] == str(folder)
    assert alignment["grid"] == "moved with the surface, nothing interpolated"
    assert run["command"] == "zlocus dsm"
    assert run["grid"]["transform"][2] == pytest.approx(WEST - PLANTED[0], abs=SHIFT_M)
    again = aligned(tmp_path / "aligned", points, tmp_path / "again")
    assert np.abs(again.fit.shift_m).max() < 0.002
    assert "the surface fits the reference as it is" in str(again)
    nested = json.loads((tmp_path / "again" / "run.json").read_text())["alignment"]["surface_alignment"]
    assert nested["offset_m"] == alignment["offset_m"]


def test_a_tilt_is_removed(tmp_path):
    folder = surface_folder(tmp_path / "surface", heights(tilt=(0.4, 0.7)))
    points = ground_points(3000)
    result = aligned(folder, gpkg(tmp_path / "p.gpkg", points), tmp_path / "aligned", tilt=True)
    assert "tilt removed: +4.0" in str(result)
    off = errors_at(tmp_path / "aligned" / "dsm.tif", points)
    plane = np.column_stack([np.ones(len(off)), (points[:, :2] - (WEST + 100, NORTH - 100)) / 100])
    up, east, north = np.linalg.lstsq(plane, off, rcond=None)[0]
    # From edge to edge twice as much.
    assert (up, 2 * east, 2 * north) == pytest.approx((0, 0, 0), abs=TILT_M)


def test_the_grid_is_kept_on_request(tmp_path):
    planted = (1.25, -2.5, 0.75)  # 2.5 and 5 cells
    z = heights(planted)
    z[100:103, 100:103] = np.nan
    folder, points = surface_folder(tmp_path / "surface", z), ground_points(2000, rim_m=8)
    result = aligned(folder, cloud(tmp_path / "p.laz", points), tmp_path / "kept", keep_grid=True)
    assert "the grid was kept" in str(result)
    for name in RASTERS:
        assert read(tmp_path / "kept" / name)[1] == TRANSFORM
    off = errors_at(tmp_path / "kept" / "dsm.tif", points)
    # Beside the hole heights are those of the nearest cell.
    assert np.nanquantile(np.abs(off), 0.99) < INTERPOLATED_M
    # Flags are those of the nearest cell; what the surface did not cover is outside.
    flags, views = read(tmp_path / "kept" / "quality.tif")[0][0], read(tmp_path / "kept" / "views.tif")[0][0]
    height = read(tmp_path / "kept" / "dsm.tif")[0][0]
    assert (flags[:, -3:] == 1).all()
    assert np.isnan(height[:, -3:]).all()
    assert np.count_nonzero(flags[:, :-5] == 16) == 9
    before = read(folder / "views.tif")[0][0]
    assert any(np.array_equal(views[10:-10, 10:-10], before[15:-5, 10 + c : c - 10 or None]) for c in (2, 3))


def test_a_raster_alone_is_moved_onto_another(tmp_path):
    x, y = grid(N)
    reference = write(tmp_path / "reference.tif", rolling(x, y).astype(np.float32))
    dsm = write(tmp_path / "dsm.tif", heights().astype(np.float32))
    result = aligned(dsm, reference, tmp_path / "out")
    assert result.fit.shift_m == pytest.approx(PLANTED, abs=SHIFT_M)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["dsm.tif", "run.json"]
    assert json.loads((tmp_path / "out" / "run.json").read_text())["command"] == "zlocus align"


def test_satellite_heights_of_passes(tmp_path, folder):
    from pyproj import Transformer

    rng, parts = np.random.default_rng(0), []
    for number in range(4):  # tracks from south to north, with an error of their own
        south = np.linspace(5, 195, 150)
        east = 40 + 35 * number + 0.1 * south
        z = rolling(east, south) + rng.normal(0, 0.1) + rng.normal(0, 0.02, 150)
        parts.append(np.column_stack([WEST + east, NORTH - south, z, np.full(150, number * 91 * 86400) + south / 7000]))
    x, y, z, time = np.concatenate(parts).T
    lon, lat = Transformer.from_crs(CRS, 4326, always_xy=True).transform(x, y)
    columns = {"longitude": [f"{a:.9f}" for a in lon], "latitude": [f"{a:.9f}" for a in lat], "h_te_best_fit": z,
               "delta_time": time, "h_canopy": np.full(len(z), 3.4e38)}  # fmt: skip
    result = aligned(folder, csv(tmp_path / "atl08.csv", columns), tmp_path / "out", PointOptions(vertical="ellipsoid"))
    assert len(result.record["passes"]) == 4
    assert "the points are of 4 passes: an error that all points of a pass share is hardly in the uncertainty" in str(
        result
    )
    assert result.fit.shift_m[2] == pytest.approx(PLANTED[2], abs=4 * result.fit.sigma_m[2])


def test_what_cannot_be_used_is_refused_and_nothing_is_written(tmp_path, folder):
    points, out = table(tmp_path), tmp_path / "out"
    far = table(tmp_path, ground=rolling, name="far.csv")
    far.write_text(far.read_text().replace(f"{int(WEST) // 1000}", "777"))
    degrees = write(
        tmp_path / "deg.tif", np.zeros((5, 5), np.float32), rasterio.Affine(1e-5, 0, 8, 0, -1e-5, 47), "EPSG:4326"
    )
    for error, sentence, call in (
        (InputError, "No point of", lambda: aligned(folder, far, out)),
        (InputError, "There is no folder|There is no raster", lambda: aligned(tmp_path / "none", points, out)),
        (InputError, "is not on a map in metres", lambda: aligned(degrees, points, out)),
        (InputError, "holds no surface, but", lambda: aligned(tmp_path, points, out)),
        (ConfigError, "holds the surface that is to be moved", lambda: aligned(folder, points, folder)),
        (ConfigError, "--max-shift 0 is not a size", lambda: aligned(folder, points, out, max_shift_m=0.0)),
    ):  # fmt: skip
        with pytest.raises(error, match=sentence):
            call()
        assert not out.exists()
    aligned(folder, points, out)
    with pytest.raises(OutputError, match="holds another run"):
        aligned(folder, points, out)
    aligned(folder, points, out, overwrite=True)


def test_a_failure_while_writing_leaves_no_folder(tmp_path, folder):
    whole = (folder / "ortho.tif").read_bytes()
    (folder / "ortho.tif").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"ortho.tif"):
        aligned(folder, table(tmp_path), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_commands_that_need_the_cameras_refuse_a_moved_surface(tmp_path, folder):
    from zlocus.io.run_record import read_record
    from zlocus.pipeline.recorded_run import request_of

    aligned(folder, table(tmp_path), tmp_path / "out")
    record = tmp_path / "out" / "run.json"
    with pytest.raises(InputError, match="was moved by `zlocus align`"):
        request_of(record, read_record(record))
