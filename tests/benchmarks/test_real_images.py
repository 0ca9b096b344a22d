"""Checks of surfaces without truth: wrong heights, occlusions and disagreements that are planted in small scenes."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from pyproj import CRS
from rasterio.transform import from_origin
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter, map_coordinates

import before_after
import independent_surfaces
import lines_of_sight
import reprojection
from benchmark_scripts import run_script
from lines_of_sight import Projection, Surface
from rows import real_images
from workplace import CannotRun
from zlocus.io.scene_file import read_scene_file
from zlocus.sensors.rpc import RpcModel
from zlocus.sensors.rpc_fit import fit_rpc
from zlocus.synthetic.cameras import SatelliteCamera

UTM = CRS.from_epsg(32632)
EAST, NORTH, CELL_M, SIDE = 500_000.0, 5_300_000.0, 0.5, 160
# A tower on flat ground: its cells, and its height in metres.
TOWER, TOWER_M = np.s_[70:90, 60:100], 12.0
PATCH, PATCH_M = np.s_[40:110, 40:100], 5.0
# Half a window of the judge, in cells: windows at the rim of a patch show both its heights and those around.
RIM = reprojection.WINDOW // 2 + 1


def surface_of(z: np.ndarray) -> Surface:
    col, row = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
    return Surface(np.dstack([EAST + col * CELL_M, NORTH - row * CELL_M, z]), CELL_M)


def texture(seed: int, plain_columns: int = 0):
    """Grey values at ground points (n, 3), of detail on a scale of a cell; plain: the first columns of the ground."""
    side = SIDE + 80
    grey = 400 + 60 * gaussian_filter(np.random.default_rng(seed).normal(size=(side, side)), 1.0) / 0.28
    grey[:, : 40 + plain_columns] = np.where(plain_columns, 400, grey[:, : 40 + plain_columns])

    def at(xyz: np.ndarray) -> np.ndarray:
        place = [(NORTH - xyz[:, 1]) / CELL_M + 39.5, (xyz[:, 0] - EAST) / CELL_M + 39.5]
        return map_coordinates(grey, place, order=1, mode="nearest")

    return at


def satellite_view(name: str, along: float, grey_at, z: np.ndarray | None = None, noise: float = 0.0):
    """A view with RPC of flat ground with a tower where `z` has one; a pixel shows the first surface on its ray."""
    shape = (SIDE + 60, SIDE + 60)
    target = (EAST + SIDE * CELL_M / 2, NORTH - SIDE * CELL_M / 2, 0.0)
    camera = SatelliteCamera(target, (shape[1] / 2, shape[0] / 2), CELL_M, along, 0.0, heading_deg=90.0)
    row, col = np.indices(shape)
    xy = np.column_stack([col.ravel(), row.ravel()]).astype(float)
    ground = camera.ground_from_image(xy, np.zeros(len(xy)))
    pixels = grey_at(ground)
    if z is not None:
        # From the top down: the first height at which the ray is inside the tower.
        for height in np.linspace(0, TOWER_M, 49):
            at = camera.ground_from_image(xy, np.full(len(xy), height))
            cell = np.floor(np.column_stack([NORTH - at[:, 1], at[:, 0] - EAST]) / CELL_M).astype(int).clip(0, SIDE - 1)
            on = z[cell[:, 0], cell[:, 1]] >= height if height else np.zeros(len(xy), bool)
            pixels[on] = grey_at(at)[on]
    pixels = pixels.reshape(shape).astype(np.float32)
    pixels += np.random.default_rng(100 + int(along)).normal(0, noise or 1e-3, shape).astype(np.float32)
    sensor = RpcModel(fit_rpc(camera, shape, UTM, (-30, 60)).rpc, UTM)
    window = SimpleNamespace(pixels=pixels, valid=np.ones(shape, bool))
    return SimpleNamespace(name=name, sensor=sensor, image=SimpleNamespace(shape=shape, read=lambda *_: window))


def judged(views, surface: Surface) -> reprojection.Reprojection:
    ((_, found),) = reprojection.reprojections(surface, views[:-1], views[-1:], search=True)
    return found


def test_wrong_heights_in_a_part_are_found_by_the_view_that_was_left_out():
    """RPCs with 0.27 m of base per metre: a wrong height of 5 m is displaced by 2.6 px. The error comes back in m."""
    views = [satellite_view(name, along, texture(1)) for name, along in (("a", -15.0), ("b", 0.0), ("c", 15.0))]
    planted = np.zeros((SIDE, SIDE), bool)
    planted[PATCH] = True
    found = judged(views, surface_of(np.where(planted, PATCH_M, 0.0)))
    displaced, error = np.zeros(planted.shape, bool), np.full(planted.shape, np.nan)
    displaced[found.where], error[found.where] = found.displaced, found.error_m
    inner, outer = binary_erosion(planted, iterations=RIM), ~binary_dilation(planted, iterations=RIM + 2)
    # The raised patch occludes a strip of its own border for each view; the rest of it is judged.
    assert (displaced & inner).sum() > 0.95 * (found.where & inner).sum() > 0.8 * inner.sum()
    assert (displaced & outer).sum() == 0
    assert np.nanmedian(error[inner]) == pytest.approx(PATCH_M, abs=0.2)
    assert np.nanmedian(np.abs(error[outer])) < 0.1
    assert found.displaced.sum() / found.judged.sum() == pytest.approx(planted.mean(), abs=0.05)
    right = judged(views, surface_of(np.zeros((SIDE, SIDE))))
    assert not right.displaced.any()
    assert not right.unlike.any()
    assert right.median > 0.95
    assert right.metres_per_pixel == pytest.approx(CELL_M / np.tan(np.deg2rad(15.0)), rel=0.05)


def test_wrong_heights_of_plain_ground_are_counted_apart():
    """The left half has no texture but noise: nothing there is called right or wrong, and nothing is dropped."""
    grey_at, half = texture(2, plain_columns=SIDE // 2), SIDE // 2
    views = [satellite_view(n, along, grey_at, noise=3.0) for n, along in (("a", -15.0), ("b", 0.0), ("c", 15.0))]
    z = np.zeros((SIDE, SIDE))
    z[:, 20:60] = PATCH_M
    found = judged(views, surface_of(z))
    told = len(found.ncc) + found.empty + found.outside + found.hidden + found.untextured + found.at_rim
    assert told == found.cells == SIDE**2
    plain = np.zeros(z.shape, bool)
    plain[found.where] = found.plain
    assert plain[:, : half - RIM][found.where[:, : half - RIM]].mean() > 0.98
    assert not plain[:, half + RIM :].any()
    assert found.displaced.sum() < 0.02 * found.judged.sum()


def test_a_tower_occludes_what_lies_behind_it_in_a_view_with_rpc():
    """The line of sight rises by a metre per tan(30 deg) = 0.58 m to the west: the strip east of the tower is occluded.

    The surface must stand three cells above the line, so the strip is shorter by their part.
    """
    z = np.zeros((SIDE, SIDE))
    z[TOWER] = TOWER_M
    surface = surface_of(z)
    view = satellite_view("a", 30.0, texture(3))
    projection = Projection.of(view.sensor, surface)
    to_east = float(np.median(projection.sight[..., 0]))
    assert abs(to_east) == pytest.approx(np.tan(np.deg2rad(30.0)), abs=0.01)
    assert np.abs(projection.sight[..., 1]).max() < 0.01
    clear = projection.clear(view.sensor, surface)
    length = (TOWER_M / CELL_M - lines_of_sight.CLEAR_CELLS) * abs(to_east)
    col = np.arange(SIDE)
    rows, cols = TOWER
    behind = (col < cols.start) & (col > cols.start - length) if to_east > 0 else (
        (col >= cols.stop) & (col < cols.stop + length))  # fmt: skip
    expected = np.ones(z.shape, bool)
    expected[rows, behind] = False
    # Squares of 2 x 2 cells are decided together.
    assert np.abs((~clear[rows]).sum(axis=1) - length).max() <= 2
    assert (clear != expected).sum() <= 2 * (rows.stop - rows.start) + 2 * length
    assert clear[TOWER].all()


def test_a_true_surface_with_a_tower_has_no_displaced_window():
    """The views show the tower; what it occludes in the left-out view is told and not judged."""
    z = np.zeros((SIDE, SIDE))
    z[TOWER] = TOWER_M
    views = [satellite_view(n, along, texture(4), z) for n, along in (("a", -15.0), ("b", 0.0), ("c", 15.0))]
    found = judged(views, surface_of(z))
    assert found.hidden > 20 * 4
    assert found.displaced.sum() < 0.01 * found.judged.sum()
    flat = judged(views, surface_of(np.zeros(z.shape)))
    # Without the tower, its roof and what it occludes are displaced or found nowhere.
    assert (flat.displaced | flat.lost).sum() > 0.8 * 20 * 40


def test_a_view_with_finer_pixels_is_reduced_to_the_cells():
    pixels = np.arange(6 * 7, dtype=np.float32).reshape(6, 7)
    np.testing.assert_array_equal(reprojection.reduced(pixels, 3), [[8, 11], [29, 32]])
    view = satellite_view("a", 0.0, texture(5))
    assert reprojection.pixels_per_cell(view.sensor, surface_of(np.zeros((SIDE, SIDE)))) == 1
    coarse = Surface(surface_of(np.zeros((SIDE, SIDE))).xyz, 4.1 * CELL_M)
    assert reprojection.pixels_per_cell(view.sensor, coarse) == 4


def test_the_noise_of_an_image_is_that_of_its_flattest_part():
    rng = np.random.default_rng(6)
    pixels = rng.normal(0, 40, (256, 256))
    pixels[:, :64] = 5 * np.arange(64) + rng.normal(0, 2.0, (256, 64))
    pixels[:64, 128:] = 255.0
    # The lowest twentieth of the blocks lies a little below the noise of all.
    assert reprojection.noise_of(pixels.astype(np.float32)) == pytest.approx(2.0, rel=0.15)


def write_surface(folder, z: np.ndarray, sigma_m: float):
    folder.mkdir()
    for name, values in (("dsm", z), ("sigma", np.where(np.isfinite(z), sigma_m, np.nan))):
        with rasterio.open(
            folder / f"{name}.tif", "w", driver="GTiff", dtype="float32", count=1, height=z.shape[0], width=z.shape[1],
            crs=UTM.to_wkt(), transform=from_origin(EAST, NORTH, CELL_M, CELL_M), nodata=np.nan,
        ) as file:  # fmt: skip
            file.write(values.astype(np.float32), 1)
    return folder


def rolling(row: np.ndarray, col: np.ndarray) -> np.ndarray:
    return 4 * np.sin(row / 9.0) + 3 * np.cos(col / 7.0 + row / 31.0)


def test_two_surfaces_disagree_in_exactly_the_planted_share(tmp_path):
    row, col = np.indices((SIDE, SIDE)).astype(float)
    z, planted = rolling(row, col), np.zeros((SIDE, SIDE), bool)
    planted[20:60, 30:80] = True
    first = write_surface(tmp_path / "first", np.where(row < 8, np.nan, z), 1.0)
    second = write_surface(tmp_path / "second", z + np.where(planted, PATCH_M, 0.0), 1.0)
    found = independent_surfaces.compare_surfaces(first, second, 3.0, (1.0, 3.0, 6.0))
    share = planted.sum() / (SIDE * (SIDE - 8))
    assert found.absolute.n == SIDE * (SIDE - 8)
    assert found.absolute.in_both == pytest.approx((SIDE - 8) / SIDE)
    assert found.absolute.beyond == {1.0: pytest.approx(share), 3.0: pytest.approx(share), 6.0: 0.0}
    # 5 m exceed three standard deviations of the difference, 3 sqrt(2) m, and not 3 sqrt(1 + 4) m.
    assert found.absolute.false == pytest.approx(share)
    wide = write_surface(tmp_path / "wide", z + np.where(planted, PATCH_M, 0.0), 2.0)
    assert independent_surfaces.compare_surfaces(first, wide).absolute.false == 0.0
    assert (found.east_m, found.north_m, found.up_m) == (0.0, 0.0, pytest.approx(0.0, abs=1e-6))
    unknown = write_surface(tmp_path / "unknown", z + np.where(planted, PATCH_M, 0.0), np.nan)
    blind = independent_surfaces.compare_surfaces(first, unknown).absolute
    assert (blind.false, blind.without_sigma) == (pytest.approx(share), 1.0)


def test_a_common_shift_is_removed_for_the_aligned_figures_only(tmp_path):
    row, col = np.indices((SIDE, SIDE)).astype(float)
    planted = (row >= 20) & (row < 60) & (col >= 30) & (col < 80)
    first = write_surface(tmp_path / "first", rolling(row, col), 0.5)
    # Moved by 3.3 cells to the east, 5.6 to the north and 7 m up.
    moved = rolling(row + 5.6, col - 3.3) + 7.0 + np.where(planted, PATCH_M, 0.0)
    found = independent_surfaces.compare_surfaces(first, write_surface(tmp_path / "second", moved, 0.5))
    shift = (found.east_m, found.north_m, found.up_m)
    assert shift == pytest.approx((3.3 * CELL_M, 5.6 * CELL_M, 7.0), abs=0.05)
    assert found.absolute.beyond[3.0] > 0.95
    assert found.aligned.beyond[3.0] == pytest.approx(planted.mean(), abs=0.01)
    assert found.aligned.false == pytest.approx(planted.mean(), abs=0.01)
    assert found.aligned.nmad_m < 0.05


def test_surfaces_on_other_grids_and_without_common_cells_are_refused(tmp_path):
    z = np.zeros((SIDE, SIDE))
    first = write_surface(tmp_path / "first", z, 1.0)
    other = write_surface(tmp_path / "other", z[:50], 1.0)
    with pytest.raises(CannotRun, match=r"different grids\. Make the second with `--like"):
        independent_surfaces.compare_surfaces(first, other)
    west, east = (np.where((np.arange(SIDE) < SIDE // 2) == side, z, np.nan) for side in (True, False))
    halves = [write_surface(tmp_path / name, half, 1.0) for name, half in (("west", west), ("east", east))]
    with pytest.raises(CannotRun, match="no cell in common"):
        independent_surfaces.compare_surfaces(*halves)


def test_a_row_judges_a_surface_by_the_image_that_was_left_out(small_town, tmp_path):
    """The whole row on three views of the small town: cameras corrected once, two views matched, the third judges."""
    images = [small_town / f"img_{name}.tif" for name in ("n1", "f1", "b1")]
    scene = real_images.orient(images, tmp_path / "oriented")
    names = [view.name for view in read_scene_file(scene).views]
    figures = real_images.left_out_figures("town", scene, names[0], real_images.Bars(0.5, 0.5, 0.1))
    values = {figure.what.removeprefix("town, "): figure for figure in figures}
    assert all(figure.passes and bool(figure.fails_when) == bool(figure.bar) for figure in figures)
    assert values["displaced > 1 px"].value < 0.2 < 0.7 < values["heights moved by 2 px: displaced"].value
    told = ("judged", "plain: cannot be judged", "hidden", "outside", "untextured", "at rim")
    assert sum(values[what].value for what in told) == pytest.approx(1.0)


def test_figures_before_and_after_a_change_stand_side_by_side(tmp_path, monkeypatch, capsys):
    for name, figures in (
        ("before", [{"what": "NMAD", "value": 0.5, "unit": "m"}, {"what": "old", "value": 2, "unit": ""}]),
        ("after", [{"what": "new", "value": None}, {"what": "NMAD", "value": 0.75, "unit": "m", "at_most": 0.6}]),
    ):
        (tmp_path / f"{name}.json").write_text(json.dumps({"row": "a", "figures": figures}))
    run_script(monkeypatch, before_after, tmp_path / "before.json", tmp_path / "after.json")
    assert capsys.readouterr().out.splitlines() == [
        "| figure | before | after | change | bar |",
        "|---|---:|---:|---:|---|",
        "| new | - | - | - |  |",
        "| NMAD (m) | 0.5 | 0.75 | +0.25 | <= 0.6 m SHORT |",
        "| old | 2 | - | - |  |",
    ]
    (tmp_path / "after.json").write_text("{}")
    with pytest.raises(CannotRun, match=r"after.json is no results file"):
        run_script(monkeypatch, before_after, tmp_path / "before.json", tmp_path / "after.json")
