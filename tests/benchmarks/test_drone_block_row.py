"""The row of the drone block: planted errors of a surface come out as figures, and a block is rendered once."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from rows import drone_block as row
from rows.photographs import n_images_around
from workplace import CannotRun, Usage, Workplace
from zlocus.synthetic.drone_block import DroneBlockSpec, render_drone_block, small_drone_block_spec

# Planted on the western half of the surface, and on its rows this far north of the middle; no heights farther south.
OFF_M, WRONG_M = 0.6, 5.0
WRONG_FROM_M, EMPTY_FROM_M = 5.0, 6.0
# Share of the cells that lie on hedges, where heights differ inside a cell and the nearest one is right.
SHARE = 0.05


@pytest.fixture(scope="module")
def spec() -> DroneBlockSpec:
    """Bare ground without relief that differs between cells."""
    bare = {"houses_per_ha": 0.0, "trees_per_ha": 0.0, "cars_per_ha": 0.0, "samples": 1}
    return small_drone_block_spec(5, columns=240, rows=180, strips=1, frames_per_strip=2, forward_overlap=0.8, **bare)


@pytest.fixture(scope="module")
def rendered(spec: DroneBlockSpec, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_drone_block(spec, tmp_path_factory.mktemp("row") / "block").folder


def write_surface(truth: Path, out: Path, cell_m: float) -> None:
    """A surface of all of the truth, with planted errors."""
    with rasterio.open(truth) as source:
        heights, transform, bounds = source.read(1), source.transform, source.bounds
    n_rows, n_cols = (int((high - low) / cell_m) for low, high in (bounds[1::2], bounds[::2]))
    x, y = bounds.left + (np.arange(n_cols) + 0.5) * cell_m, bounds.top - (np.arange(n_rows) + 0.5) * cell_m
    col, row = (x - transform.c) / transform.a, (y - transform.f) / transform.e
    z = heights[np.ix_(row.astype(int), col.astype(int))]
    west, north = x < x.mean(), y > y.mean() + WRONG_FROM_M
    z[:, west] += OFF_M
    z[north] += WRONG_M
    z[y < y.mean() - EMPTY_FROM_M] = np.nan
    out.mkdir(parents=True)
    profile = {"driver": "GTiff", "height": n_rows, "width": n_cols, "count": 1, "dtype": "float32"}
    grid = {"crs": "EPSG:32632", "transform": from_origin(bounds.left, bounds.top, cell_m, cell_m), "nodata": np.nan}
    with rasterio.open(out / "dsm.tif", "w", **profile, **grid) as file:
        file.write(z.astype(np.float32), 1)


def test_the_row_renders_matches_and_judges(
    spec: DroneBlockSpec, rendered: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a surface whose errors are known in place of the matching."""
    commands = []

    def matched(command: list[object], **options: object) -> Usage:
        commands.append(command)
        cell_m = float(command[command.index("--resolution") + 1])
        assert cell_m == 2 * spec.ground_pixel_m
        write_surface(tmp_path / "block" / "truth_dsm.tif", tmp_path / "dsm", cell_m)
        stages = [{"name": "match", "cpu_s": 3.0, "peak_mb": 500.0}, {"name": "write", "cpu_s": 1.0, "peak_mb": 900.0}]
        (tmp_path / "dsm" / "run.json").write_text(json.dumps({"stages": stages}))
        return Usage(4.0, 0.9)

    monkeypatch.setattr(row, "run", matched)
    shutil.copytree(rendered, tmp_path / "block")
    workplace = Workplace(None, tmp_path)
    figures = {figure.what: figure for figure in row.drone_block(workplace, spec)}
    assert len(commands) == 1
    assert workplace.inputs["seeds"] == [5]
    values = {name: figure.value for name, figure in figures.items()}
    with rasterio.open(tmp_path / "dsm" / "dsm.tif") as source:
        bounds = source.bounds
    middle = (bounds.left + bounds.right) / 2, (bounds.bottom + bounds.top) / 2
    x, y = row.true_cells(row.read_heights(tmp_path / "dsm" / "dsm.tif"), rendered).xy.T
    has_height, is_wrong, is_off = y >= middle[1] - EMPTY_FROM_M, y > middle[1] + WRONG_FROM_M, x < middle[0]
    assert spec.ground_pixel_m * 2 < OFF_M < 1.0
    assert 0.05 < is_wrong.mean() < has_height.mean() < 0.95
    assert values["filled"] == pytest.approx(has_height.mean(), abs=SHARE)
    assert values["off by more than 3 m"] == pytest.approx(is_wrong.mean(), abs=SHARE)
    is_right = has_height & ~is_wrong & ~is_off
    assert values["within two ground pixels: all"] == pytest.approx(is_right.mean(), abs=SHARE)
    assert values["within two ground pixels: ground"] == pytest.approx(is_right.mean(), abs=SHARE)
    assert values["within 1 m: all"] == pytest.approx((has_height & ~is_wrong).mean(), abs=SHARE)
    assert values["CPU per million cells"] == pytest.approx(4.0 / (len(x) / 1e6))
    # The small block lies in the square that is the middle of a large one.
    of_whole = "within two ground pixels: ground"
    assert values[f"middle, {of_whole}"] == values[of_whole]
    assert values["peak memory of a process"] == 0.9
    assert all(figure.fails_when for figure in figures.values() if figure.bar)


def test_only_cells_inside_two_frames_are_judged(spec: DroneBlockSpec, rendered: Path, tmp_path: Path) -> None:
    """The truth reaches beyond the frames; each judged cell has nine known heights around its centre."""
    write_surface(rendered / "truth_dsm.tif", tmp_path / "dsm", 2 * spec.ground_pixel_m)
    surface = row.read_heights(tmp_path / "dsm" / "dsm.tif")
    cells = row.true_cells(surface, rendered)
    assert 0 < len(cells.xy) < surface.z.size
    assert cells.heights.shape == (len(cells.xy), 9)
    truth = row.read_heights(rendered / "truth_dsm.tif")
    np.testing.assert_allclose(cells.heights[:, 4], truth.nearest(cells.xy), rtol=0, atol=1e-3)
    assert (n_images_around(rendered, np.column_stack([cells.xy, cells.heights[:, 4]])) >= 2).all()


def test_another_block_in_the_folder_is_not_used(spec: DroneBlockSpec, rendered: Path, tmp_path: Path) -> None:
    shutil.copytree(rendered, tmp_path / "block")
    with pytest.raises(CannotRun, match="holds another scene; remove it"):
        row.drone_block(Workplace(None, tmp_path), small_drone_block_spec(6))


def test_either_side_of_an_edge_is_right() -> None:
    flat, edge = [5.0] * 9, [5.0] * 6 + [8.0] * 3
    found = row.errors_of_cells(np.array([5.5, 8.1, 6.0, np.nan]), np.array([flat, edge, edge, flat]))
    np.testing.assert_allclose(found, [0.5, 0.1, 1.0, np.nan], rtol=0, atol=1e-9)


def test_points_behind_a_wall_are_seen_by_the_frames_beyond_it_only(rendered: Path, tmp_path: Path) -> None:
    """A wall from north to south on a level truth; rays are followed by the rule of three instead of step by step."""
    wall_m, borderline_m = 15.0, 0.4
    scene = Path(shutil.copytree(rendered, tmp_path / "block"))
    with rasterio.open(scene / "truth_dsm.tif", "r+") as file:
        n_cols, level_m = file.width, float(np.nanmean(file.read(1)))
        wall_col = n_cols // 4
        heights = np.full((file.height, n_cols), level_m, np.float32)
        wall_x = (file.transform * (wall_col + 0.5, 0))[0]
        heights[:, wall_col] += wall_m
        file.write(heights, 1)
        rows, cols = (axis.ravel() for axis in np.mgrid[4 : file.height : 9, 3:n_cols:7])
        xyz = np.column_stack([*(file.transform * (cols + 0.5, rows + 0.5)), np.full(len(rows), level_m)])
    top = level_m + wall_m
    inside_of, expected = np.zeros(len(xyz), int), np.zeros(len(xyz), int)
    is_clear = np.abs(xyz[:, 0] - wall_x) > borderline_m
    for view in row.open_scene([scene / "scene.yaml"]).views:
        xy, centre = view.sensor.image_from_ground(xyz), view.sensor.centre
        inside = ((xy >= 0) & (xy <= np.array(view.image.shape[::-1]) - 1)).all(axis=1)
        share = (wall_x - xyz[:, 0]) / (centre[0] - xyz[:, 0])
        at_wall = xyz[:, 2] + share * (centre[2] - xyz[:, 2])
        is_between = (share > 0) & (share < 1)
        inside_of += inside
        expected += inside & ~(is_between & (at_wall < top))
        is_clear &= ~is_between | (np.abs(at_wall - top) > borderline_m)
    found = row.n_frames_that_see(scene, xyz)
    np.testing.assert_array_equal(found[is_clear], expected[is_clear])
    assert ((found < inside_of) & is_clear).sum() > 10
