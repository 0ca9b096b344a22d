"""Projection tables against the exact models, and where pixels of a pyramid level lie."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from affine import Affine

from orientation_scenes import image_of
from rendered_scenes import CENTRE, camera, line_scanner
from zlocus.core.errors import GeometryError
from zlocus.core.scene import View
from zlocus.io.scene_file import open_scene
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.occlusion import covered_heights, covers, excluded_view_mask, mark_occlusions
from zlocus.matching.radiometry import GreyScale
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.tile_views import (
    FINEST_BENT_PX,
    FINEST_TABLE_PX,
    LARGEST_BENT_BLOCK,
    MAX_EXCLUDED_SHARE_AT_LAST,
    TileGrid,
    tile_views,
)
from zlocus.matching.view_pixels import PixelWindow, ViewPixels, halved, read_pixels
from zlocus.sensors.distortion import BrownDistortion
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.sensors.linescan import RectifiedModel
from zlocus.sensors.projection_table import (
    HIGHEST_DEGREE,
    TOLERANCE_PX,
    UNSTEADY_DEGREE,
    TableRequest,
    in_powers_of_t,
    longest_run,
    projection_table,
    projection_table_where_shown,
)
from zlocus.synthetic.cameras import LineScanner, SatelliteCamera
from zlocus.synthetic.scenes import demo_spec, exposures_of

HEIGHTS = (20.0, 140.0)
# Rounding of float32 grey values, in contrasts of the image.
FLOAT32_CONTRASTS = 1e-5


def steep():
    return SatelliteCamera((*CENTRE, 50.0), (500.0, 500.0), 0.5, 45.0, -20.0, 30.0, 30_000.0)


def airborne(wobble=0.03):
    """A backward line of an ADS40, 2000 m above ground, far from the nadir."""
    position = (CENTRE[0] - 900.0, CENTRE[1] + 500.0, 2050.0)
    return LineScanner(position, (6000.0, 4000.0), 0.0, -14.0, 0.208, wobble_m=0.5, wobble_deg=wobble)


def grid(cell_m, shape):
    return Affine(cell_m, 0, CENTRE[0] - cell_m * shape[1] / 2, 0, -cell_m, CENTRE[1] + cell_m * shape[0] / 2)


def worst_gap(sensor, table, transform, shape, block, n=4000):
    """Largest distance of the table from the exact model at random cells and heights, px."""
    rng = np.random.default_rng(1)
    row, col = rng.integers(0, shape[0], n), rng.integers(0, shape[1], n)
    t = rng.uniform(-1, 1, n)
    x, y = transform * (col + 0.5, row + 0.5)
    exact = sensor.image_from_ground(np.column_stack([x, y, table.z_mid + t * table.z_half]))
    b, d = row // block, col // block
    u, v = ((col % block) / block)[:, None], ((row % block) / block)[:, None]
    at = [[(table.nodes[b + i, d + j] * (t[:, None] ** np.arange(4))[:, None]).sum(-1) for j in (0, 1)] for i in (0, 1)]
    found = (1 - v) * ((1 - u) * at[0][0] + u * at[0][1]) + v * ((1 - u) * at[1][0] + u * at[1][1])
    return np.linalg.norm(found - exact, axis=1).max()


@pytest.mark.parametrize(
    ("sensor", "cell_m"), [(steep(), 0.5), (airborne(), 0.2), (airborne(), 0.8), (camera("aft"), 2)]
)
def test_steep_and_wide_views(sensor, cell_m):
    shape, block = (150, 203), 32
    transform = grid(cell_m, shape)
    table = projection_table(sensor, TableRequest(transform, shape, block, HEIGHTS))
    assert table.nodes.shape == (6, 8, 2, 4)
    assert worst_gap(sensor, table, transform, shape, block) < TOLERANCE_PX


def test_real_satellite_models(shared_data):
    """RPC of a Pleiades triplet, over its whole relief and more."""
    scene = open_scene(sorted((shared_data / "pleiades_triplet_calanques").glob("img_0*.tif")))
    transform = Affine(0.5, 0, 698_000.0, 0, -0.5, 4_793_000.0)
    for view in scene.views:
        table = projection_table(view.sensor, TableRequest(transform, (700, 700), 32, (50.0, 350.0)))
        assert worst_gap(view.sensor, table, transform, (700, 700), 32) < TOLERANCE_PX


def test_blocks_too_large_are_refused():
    """A scanner that shakes within a block."""
    shape = (512, 512)
    with pytest.raises(GeometryError, match=r"of 256 cells is .* Use a smaller block"):
        projection_table(airborne(0.3), TableRequest(grid(0.4, shape), shape, 256, HEIGHTS))
    projection_table(airborne(0.3), TableRequest(grid(0.4, shape), shape, 8, HEIGHTS))


def test_a_sensor_that_maps_nothing_shows_nothing():
    class Blind:
        def image_from_ground(self, xyz):
            return np.full((len(xyz), 2), np.nan)

    table = projection_table(Blind(), TableRequest(grid(0.5, (64, 64)), (64, 64), 32, HEIGHTS))
    assert not table.holds.any()
    assert np.isfinite(table.nodes).all()


LENS = BrownDistortion(k1=-0.26, k2=0.1, k3=-0.026)


def drone(distortion=LENS, omega=30.0):
    """105 m above the ground, tilted, with a wide lens whose distortion folds outside of the image."""
    rotation = rotation_from_angles(omega, 0.0, 0.0)
    return FrameModel((*CENTRE, 155.0), rotation, 911.0, (683.5, 455.5), distortion=distortion)


IMAGE = (0, 0, 912, 1368)


def test_what_a_lens_cannot_see_is_not_seen():
    """Blocks behind the fold, and behind the camera, hold nowhere; the others are as exact as ever."""
    shape, block, sensor = (600, 600), 8, drone()
    transform = grid(0.5, shape)
    rows, cols = np.mgrid[0:601:8, 0:601:8]
    x, y = transform * (cols + 0.5, rows + 0.5)
    known = [
        np.isfinite(sensor.image_from_ground(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)]))).all(axis=1)
        for z in np.linspace(45.2, 54.8, 5)
    ]
    whole = np.all(known, axis=0).reshape(x.shape)
    assert 0.1 < whole.mean() < 0.9
    table = projection_table(sensor, TableRequest(transform, shape, block, (45.0, 55.0), 2.0, HIGHEST_DEGREE), IMAGE)
    assert np.isfinite(table.nodes).all()
    corners = whole[:-1, :-1] & whole[1:, :-1] & whole[:-1, 1:] & whole[1:, 1:]
    assert not (table.holds & ~corners).any()
    # Every cell that the image shows is in a block that holds.
    row, col = np.mgrid[0:600, 0:600]
    x, y = transform * (col + 0.5, row + 0.5)
    xy = sensor.image_from_ground(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 50.0)]))
    shown = ((xy > 0) & (xy < (1367, 911))).all(axis=1).reshape(shape)
    assert table.holds[row[shown] // block, col[shown] // block].mean() > 0.99


def test_coverage_leaves_out_what_does_not_hold():
    shape, sensor = (600, 600), drone()
    pixels = np.zeros((912, 1368), np.float32)
    window = ViewPixels(sensor, (0, 0), pixels, np.ones(pixels.shape, bool))
    views = tile_views(
        [window, window], TileGrid(0, grid(0.15, shape), shape, 32, 45.0, 0.5), (40.0, 60.0), 4, (45.0, 55.0)
    )
    assert views.block < 32
    assert not views.is_projected.all()
    base = SlopeSurface.flat(shape, views.block)
    n = (-(-600 // views.block),) * 2
    lattice = HeightLattice(45.0, 0.5, shape, views.block, np.zeros(n, np.int64), np.full(n, 20))
    seen = covers(covered_heights(views, base, lattice))
    row, col = np.mgrid[0:600, 0:600]
    x, y = grid(0.15, shape) * (col + 0.5, row + 0.5)
    xy = sensor.image_from_ground(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 50.0)]))
    inside = ((xy > 4) & (xy < (1363, 907))).all(axis=1).reshape(shape)
    assert not (seen[0] & ~((xy > 0) & (xy < (1367, 911))).all(axis=1).reshape(shape)).mean() > 0.02
    assert (seen[0] & inside).sum() > 0.97 * inside.sum()
    unmapped = ~views.is_projected[0].repeat(views.block, 0).repeat(views.block, 1)[:600, :600]
    assert not seen[0][unmapped].any()
    mark_occlusions(
        VisibleHeights(*np.zeros((3, 2, *shape), np.int32)),
        views,
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        0.0,
    )


def test_tables_hold_over_heights_that_reach_close_to_the_camera():
    """From 170 to 55 m below a tilted wide lens, no block that shows the ground is left out."""
    shape, pixels = (400, 400), np.zeros((912, 1368), np.float32)
    window = ViewPixels(drone(), (0, 0), pixels, np.ones(pixels.shape, bool))
    views = tile_views([window], TileGrid(0, grid(0.15, shape), shape, 32, -15.0, 0.5), (-15.0, 100.0), 4)
    assert not views.is_excluded.any()
    assert views.is_projected.mean() > 0.3


def shown_errors(table, sensor, transform, shape, block, window):
    """(n,) px, of the table where it holds and the window shows a cell, at heights between its samples; and how many
    cells and heights the window shows that it leaves out."""
    rng, errors, left_out, n_shown = np.random.default_rng(4), [], 0, 0
    for t in rng.uniform(-1.0, 1.0, 40):
        row, col = rng.integers(0, shape[0], 400), rng.integers(0, shape[1], 400)
        x, y = transform * (col + 0.5, row + 0.5)
        exact = sensor.image_from_ground(np.column_stack([x, y, np.full(400, table.z_mid + t * table.z_half)]))
        shown = ((exact >= window[1::-1]) & (exact <= np.array(window[1::-1]) + np.array(window[:1:-1]) - 1)).all(
            axis=1
        )
        b, d = row // block, col // block
        fr, fc = (row % block / block)[:, None], (col % block / block)[:, None]
        at = [[table.nodes[b + i, d + j] @ t ** np.arange(table.nodes.shape[-1]) for j in (0, 1)] for i in (0, 1)]
        xy = (1 - fr) * ((1 - fc) * at[0][0] + fc * at[0][1]) + fr * ((1 - fc) * at[1][0] + fc * at[1][1])
        if table.bends.shape[-1]:
            bends = table.bends[b, d] @ t ** np.arange(table.bends.shape[-1])
            xy += block**2 * (fr * (fr - 1) * bends[:, 0] + fc * (fc - 1) * bends[:, 1])
        held = table.holds[b, d] & (table.ends[b, d, 0] <= t) & (t <= table.ends[b, d, 1])
        errors.append(np.hypot(*(xy - exact)[shown & held].T))
        left_out, n_shown = left_out + (shown & ~held).sum(), n_shown + shown.sum()
    return np.concatenate(errors), left_out / n_shown


@pytest.mark.parametrize("omega", [0.0, 30.0, 55.0])
def test_each_block_is_tabulated_over_the_heights_at_which_it_is_shown(omega):
    """From 130 to 15 m below a camera a block leaves the image, the lens and what is in front of it; where it is shown
    the table is exact, and hardly anything is left out."""
    shape, block, sensor = (500, 500), 2, drone(omega=omega)
    transform = grid(0.4, shape)
    heights = (25.0, 140.0)
    request = TableRequest(transform, shape, block, heights, FINEST_BENT_PX, HIGHEST_DEGREE)
    with pytest.raises(GeometryError):
        projection_table(sensor, request, IMAGE)
    table = projection_table_where_shown(sensor, request, IMAGE, MAX_EXCLUDED_SHARE_AT_LAST, may_drop_heights=True)
    errors, left_out = shown_errors(table, sensor, transform, shape, block, IMAGE)
    assert len(errors) > 300
    assert errors.max() < 1.5 * FINEST_BENT_PX
    assert left_out < 0.25
    low = projection_table_where_shown(
        sensor, replace(request, z_range=(25.0, 90.0)), IMAGE, MAX_EXCLUDED_SHARE_AT_LAST, may_drop_heights=True
    )
    assert shown_errors(low, sensor, transform, shape, block, IMAGE)[1] < 0.02


@pytest.mark.parametrize("omega", [0.0, 30.0])
def test_blocks_that_may_bend_are_exact_where_straight_ones_are_not(omega):
    """A lens bends rows of sixteen cells by more than the tolerance of the finest level."""
    shape, block, sensor = (500, 500), 16, drone(omega=omega)
    transform = grid(0.15, shape)
    straight = TableRequest(transform, shape, block, (25.0, 70.0), FINEST_TABLE_PX, HIGHEST_DEGREE)
    with pytest.raises(GeometryError):
        projection_table_where_shown(sensor, straight, IMAGE, 0.01, may_drop_heights=False)
    bent = replace(straight, is_bent=True)
    table = projection_table_where_shown(sensor, bent, IMAGE, 0.01, may_drop_heights=False)
    errors, left_out = shown_errors(table, sensor, transform, shape, block, IMAGE)
    assert len(errors) > 300
    assert errors.max() < 1.5 * FINEST_TABLE_PX
    assert left_out < 0.02
    everywhere = projection_table(sensor, replace(bent, z_range=(25.0, 35.0)), IMAGE)
    assert shown_errors(everywhere, sensor, transform, shape, block, IMAGE)[0].max() < 1.5 * FINEST_TABLE_PX


def test_what_is_too_bent_is_refused_unless_it_may_be_left_out():
    shape, sensor = (200, 200), drone()
    request = TableRequest(grid(1.0, shape), shape, 4, (25.0, 140.0), FINEST_BENT_PX, HIGHEST_DEGREE)
    with pytest.raises(GeometryError, match=r"of 4 cells is .* Use a smaller block or fewer heights"):
        projection_table_where_shown(sensor, request, IMAGE, MAX_EXCLUDED_SHARE_AT_LAST, may_drop_heights=False)
    table = projection_table_where_shown(sensor, request, IMAGE, 1.0, may_drop_heights=True)
    assert table.lost.any()
    assert table.holds.any()
    assert np.isfinite(table.nodes).all()


def test_polynomials_of_a_part_of_the_heights_are_those_of_all():
    local = np.random.default_rng(1).normal(size=(5, 2, 8))
    middle, half = np.linspace(-0.5, 0.5, 5), np.linspace(0.2, 0.5, 5)
    moved, t = in_powers_of_t(local, middle, half), 0.37
    s = (t - middle) / half
    expected = np.einsum("cxp,cp->cx", local, s[:, None] ** np.arange(8))
    np.testing.assert_allclose(moved @ t ** np.arange(8), expected, rtol=1e-9)


def test_longest_runs():
    flags = np.array([[1, 1, 0, 1, 1, 1, 0], [0, 0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 1]], bool)
    first, last = longest_run(flags)
    assert (first[0], last[0]) == (3, 5)
    assert (first[2], last[2]) == (6, 6)


@pytest.fixture(scope="module")
def unsteady():
    """Raw and level 1 models of a line that looks ahead from an unsteady flight."""
    spec = replace(demo_spec(), size=200, views=demo_spec().views[1:2])
    (exposure,) = exposures_of(spec)
    raw = line_scanner(exposure)
    plane = RectifiedModel(raw, raw, exposure.sensor.height, exposure.sensor.plane_from_image)
    return spec, raw, plane


def test_raw_lines_of_an_unsteady_flight_need_a_high_degree(unsteady):
    spec, raw, plane = unsteady
    shape, z = (64, 64), (430.0, 500.0)
    around = Affine(0.2, 0.0, spec.west_m + 10.0, 0.0, -0.2, spec.north_m - 10.0)
    assert projection_table(plane, TableRequest(around, shape, 16, z)).holds.all()
    with pytest.raises(GeometryError, match="px from the exact model"):
        projection_table(raw, TableRequest(around, shape, 4, z, FINEST_BENT_PX, HIGHEST_DEGREE))
    pixels = np.zeros((300, 300), np.float32)
    window = ViewPixels(raw, (0, 0), pixels, np.ones(pixels.shape, bool))
    views = tile_views([window], TileGrid(0, around, shape, 32, 430.0, 0.5), z, 4)
    assert views.nodes.shape[-1] == UNSTEADY_DEGREE + 1
    assert views.is_projected.any()
    assert not views.is_excluded.any()


def test_flights_too_unsteady_for_raw_images_are_told_so(unsteady):
    spec, raw, _ = unsteady
    shape = (16, 16)
    around = Affine(0.2, 0.0, spec.west_m + 10.0, 0.0, -0.2, spec.north_m - 10.0)
    pixels = np.zeros((300, 300), np.float32)
    # 3 cm from line to line. More takes the exact model a minute to solve, and says the same.
    jitter = np.random.default_rng(1).normal(0.0, 0.03, raw.trajectory.centres.shape)
    shaken = replace(raw.trajectory, centres=raw.trajectory.centres + jitter)
    window = ViewPixels(replace(raw, trajectory=shaken), (0, 0), pixels, np.ones(pixels.shape, bool))
    with pytest.raises(GeometryError, match=r"too unsteady for its raw images.*level 1"):
        tile_views([window], TileGrid(0, around, shape, 32, 430.0, 0.5), (430.0, 500.0), 4)


def test_blocks_from_which_a_view_is_left_out_are_named():
    """A camera in the midst of the heights searched cannot be tabulated; what it may show is lost, not unseen."""
    shape, pixels = (64, 64), np.zeros((912, 1368), np.float32)
    sensor = replace(drone(), centre=(*CENTRE, 130.0))
    window = ViewPixels(sensor, (0, 0), pixels, np.ones(pixels.shape, bool))
    table = projection_table(sensor, TableRequest(grid(0.5, shape), shape, 8, (15.0, 128.0), 0.01, 3), IMAGE, 1.0)
    assert table.lost.any()
    # Ground 80 m ahead is in the image from 100 m above it, and beyond the fold of the distortion from 3 m.
    ahead = grid(0.5, shape) * Affine.translation(0.0, -160.0)
    for z, is_shown in ((55.0, True), (152.0, False)):
        assert np.isfinite(drone().image_from_ground(np.array([[*(ahead * (32.5, 32.5)), z]]))).all() == is_shown
    both = projection_table(drone(), TableRequest(ahead, shape, 8, (30.0, 153.0), 2.0, 7), IMAGE, 1.0)
    assert (both.lost & ~both.holds).mean() > 0.8
    assert not (table.lost & table.holds).any()
    views = tile_views([window], TileGrid(0, grid(0.5, shape), shape, 32, 15.0, 0.5), (15.0, 60.0), 4)
    named = replace(views, is_excluded=np.zeros_like(views.is_excluded))
    assert not excluded_view_mask(named, shape).any()
    named.is_excluded[0, 1, 2] = True
    side = views.block
    marked = excluded_view_mask(named, shape)
    assert marked[side : 2 * side, 2 * side : 3 * side].all()
    assert marked.sum() == side**2


def test_perspective_shrinks_blocks_and_raises_the_degree_only_where_needed():
    """A camera that looks straight down from 2 km keeps its blocks; those of one that is tilted, and close, bend."""
    pixels = np.zeros((912, 1368), np.float32)

    def fitted(sensor):
        window = ViewPixels(sensor, (0, 0), pixels, np.ones(pixels.shape, bool))
        return tile_views([window], TileGrid(0, grid(0.15, (256, 256)), (256, 256), 32, 45.0, 0.5), (40.0, 60.0), 4)

    far = FrameModel((*CENTRE, 2050.0), rotation_from_angles(0.0, 0.0, 10.0), 13_000.0, (683.5, 455.5))
    assert (fitted(far).block, fitted(far).nodes.shape[-1], fitted(far).bends.shape[-1]) == (32, 4, 0)
    near = fitted(drone(None))
    assert near.block == LARGEST_BENT_BLOCK
    assert near.bends.shape[-1] == near.nodes.shape[-1] > 4


@pytest.mark.parametrize("level", [0, 1, 2])
def test_pixels_of_a_level(level):
    """A cell at (x, y) px of the image is at (x + 0.5) / 2^level - 0.5 px of the level, less the window's origin."""
    sensor, shape, block = camera("fore"), (40, 50), 16
    transform = grid(0.5 * 2**level, shape)
    origin, pixels = (3, 5), np.zeros((96 // 2**level, 112 // 2**level), np.float32)
    window = ViewPixels(sensor, origin, pixels, np.ones(pixels.shape, bool), level=level)
    lattice = (30.0, 1.5)
    views = tile_views([window], TileGrid(level, transform, shape, block, *lattice), HEIGHTS, 2)
    for row, col, k in ((0, 0, 0), (16, 32, 7), (32, 48, 30)):
        t = views.t_of_index[0] + k * views.t_of_index[1]
        x, y = views.nodes[0, row // block, col // block] @ t ** np.arange(4)
        ground = np.array([[*(transform * (col + 0.5, row + 0.5)), lattice[0] + k * lattice[1]]])
        exact = (sensor.image_from_ground(ground)[0] + 0.5) / 2**level - 0.5 - np.array(origin[::-1])
        np.testing.assert_allclose((x, y), exact, rtol=0, atol=TOLERANCE_PX)


def test_pixels_of_a_window_are_on_the_scale_of_all_views():
    """The view's own zero and one, at every level, wherever the window starts."""
    pixels = 500.0 + 40.0 * np.random.default_rng(0).normal(size=(40, 60))
    view = View("v", Path("v.tif"), image_of(pixels), camera("fore"))
    plain, scale = (pixels[4:28, 8:40] - 480.0) / 25.0, GreyScale(480.0, 25.0)
    for level in range(3):
        side = 2**level
        window = PixelWindow(4 // side, 8 // side, 24 // side, 32 // side)
        read = read_pixels(view, window, scale, level)
        assert (read.origin, read.scale, read.window) == ((4 // side, 8 // side), scale, window)
        means = plain.reshape(24 // side, side, 32 // side, side).mean(axis=(1, 3))
        np.testing.assert_allclose(read.pixels, means, rtol=0, atol=FLOAT32_CONTRASTS)


def test_halved_pixels_lie_between_four():
    """The mean of a ramp in column and row is the ramp at (2 c + 0.5, 2 r + 0.5); odd last ones are dropped."""
    row, col = np.indices((9, 13)).astype(np.float32)
    coarse, valid = halved(col + 100 * row, np.ones((9, 13), bool))
    r, c = np.indices((4, 6))
    np.testing.assert_array_equal(coarse, (2 * c + 0.5) + 100 * (2 * r + 0.5))
    assert valid.all()


def test_halved_pixels_skip_what_is_not_valid():
    pixels, valid = np.full((4, 6), 3.0, np.float32), np.ones((4, 6), bool)
    pixels[0, 0], valid[0, 0] = 900, False
    valid[0:2, 2:4] = [[False, True], [False, True]]
    coarse, kept = halved(pixels, valid)
    assert coarse[0, 0] == 3.0
    np.testing.assert_array_equal(kept, [[True, False, True], [True, True, True]])
