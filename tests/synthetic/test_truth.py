"""Truth rasters over all ground that two images show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import rasterio

from zlocus.synthetic.scenes import ADS40_VIEWS, build_ground, demo_spec, exposures_of, steady
from zlocus.synthetic.truth import image_positions, n_images_showing, write_truth

# Positions are interpolated between the nodes of a grid.
POSITION_PX = 0.1


@pytest.fixture(scope="module")
def spec():
    """A small part of the demo, from two of its images."""
    views = tuple(view for view in ADS40_VIEWS if view.name in ("f1", "b2"))
    return replace(demo_spec(), size=60, views=views, whole_truth=True)


@pytest.fixture(scope="module")
def seen_by(spec):
    return exposures_of(spec)


@pytest.fixture(scope="module")
def ground(spec):
    return build_ground(spec, exposures_of(steady(spec)))


def some_cells(ground, n=300):
    rng = np.random.default_rng(8)
    row, col = (rng.integers(0, size, n) for size in ground.heights.shape)
    x, y = ground.x0 + (col + 0.5) * ground.step, ground.y0 - (row + 0.5) * ground.step
    return (row, col), np.column_stack([x, y, ground.heights[row, col].astype(float)])


def test_positions_in_images_are_those_of_the_exact_camera(ground, seen_by):
    cells, xyz = some_cells(ground)
    for exposure in seen_by:
        found = image_positions(ground, exposure)[cells]
        np.testing.assert_allclose(found, exposure.sensor.image_from_ground(xyz), rtol=0, atol=POSITION_PX)


def test_images_show_what_projects_inside_their_borders(ground, seen_by):
    cells, xyz = some_cells(ground)
    expected = np.zeros(len(xyz), int)
    near = np.zeros(len(xyz), bool)
    for exposure in seen_by:
        xy = exposure.sensor.image_from_ground(xyz)
        last = np.array([exposure.shape[1] - 1, exposure.shape[0] - 1])
        expected += ((xy >= 0) & (xy <= last)).all(axis=1)
        near |= (np.minimum(np.abs(xy), np.abs(xy - last)) < POSITION_PX).any(axis=1)
    assert {0, 1, 2} == set(expected.tolist())
    np.testing.assert_array_equal(n_images_showing(ground, seen_by)[cells][~near], expected[~near])


def test_the_truth_has_a_height_where_two_images_see_and_nowhere_else(tmp_path, spec, ground, seen_by):
    write_truth(spec, ground, seen_by, tmp_path)
    with rasterio.open(tmp_path / "truth_dsm.tif") as file:
        truth, transform = file.read(1), file.transform
    with rasterio.open(tmp_path / "truth_class.tif") as file:
        classes = file.read(1)
    rows, cols = ground.cells(transform.c, transform.f, truth.shape)
    known = n_images_showing(ground, seen_by) >= 2
    np.testing.assert_array_equal(np.isfinite(truth), known[rows, cols])
    assert known.sum() == known[rows, cols].sum()
    # More than the area that all images were placed for.
    assert known.sum() * spec.step_m**2 > (spec.size * spec.gsd_m) ** 2
    np.testing.assert_array_equal(truth[known[rows, cols]], ground.heights[rows, cols][known[rows, cols]])
    np.testing.assert_array_equal(classes, ground.classes[rows, cols])
