"""Match scene: order of the views, height step, levels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orientation_scenes import image_of
from rendered_scenes import CENTRE, UTM, line_scanner
from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.grid import CellWindow
from zlocus.core.height_range import HeightRange
from zlocus.core.options import PyramidOptions
from zlocus.core.scene import Scene, View
from zlocus.matching.ground_pixels import check_resolution, median_ground_pixel
from zlocus.matching.match_scene import build_match_scene, height_step, levels_for, parallax_rate, reference_first
from zlocus.matching.radiometry import grey_scales
from zlocus.synthetic.cameras import SatelliteCamera
from zlocus.synthetic.scenes import ViewSpec, demo_spec, exposures_of, steady

GREY = np.random.default_rng(0).normal(500, 40, (120, 160))


def view(name, along=0.0, across=0.0, gsd=0.5, east=0.0, pixels=GREY):
    rows, cols = pixels.shape
    target = (CENTRE[0] + east, CENTRE[1], 50.0)
    sensor = SatelliteCamera(target, ((cols - 1) / 2, (rows - 1) / 2), gsd, along, across)
    return View(name, Path(f"{name}.tif"), image_of(pixels), sensor)


def scene(*views):
    return Scene(views, UTM)


def test_the_most_nadir_view_is_the_reference_image():
    views = scene(view("aft", -20), view("mid", 3), view("fore", 12))
    assert [v.name for v in reference_first(views, 50.0, None)] == ["mid", "fore", "aft"]
    assert [v.name for v in reference_first(views, 50.0, "aft")] == ["aft", "mid", "fore"]
    with pytest.raises(ConfigError, match=r"--reference north .* aft, mid, fore"):
        reference_first(views, 50.0, "north")


def test_order_of_images_does_not_matter():
    a, b, c = view("a", 10), view("b", -10), view("c", 1)
    assert reference_first(scene(a, b, c), 50.0, None) == reference_first(scene(c, b, a), 50.0, None)


def test_the_parallax_rate_is_the_tangent_of_the_view_angle():
    east, north = parallax_rate(view("v", along=20, across=-10), 50.0)
    assert -north == pytest.approx(np.tan(np.deg2rad(20)), rel=1e-3)
    assert -east == pytest.approx(np.tan(np.deg2rad(-10)), rel=1e-3)


def test_the_step_moves_the_most_sensitive_image_by_half_a_pixel():
    """Equivalent disparity: (tan 20 + tan 2) dz / 0.5 m = 0.5 px."""
    views = reference_first(scene(view("n", 2), view("f", -20), view("m", -5)), 50.0, None)
    step = height_step(views, 50.0, 0.5, 0.5)
    assert step == pytest.approx(0.25 / (np.tan(np.deg2rad(20)) + np.tan(np.deg2rad(2))), rel=1e-3)
    assert height_step(views, 50.0, 0.5, 0.25) == pytest.approx(step / 2)
    # Nothing finer than a cell is compared.
    assert height_step(views, 50.0, 1.0, 0.5) == pytest.approx(step * 2)


def test_views_along_one_line_show_no_height():
    with pytest.raises(GeometryError, match="same line"):
        height_step((view("a", 5), view("b", 5)), 50.0, 0.5, 0.5)


@pytest.mark.parametrize(("n_steps", "levels"), [(4, 3), (256, 3), (257, 4), (1024, 5), (10**6, 6)])
def test_there_are_as_many_levels_as_make_the_range_short(n_steps, levels):
    assert levels_for(n_steps, PyramidOptions(max_coarsest_steps=64)) == levels
    assert levels_for(n_steps, PyramidOptions(max_levels=1)) == 1


def test_ground_pixel_and_resolution():
    views = scene(view("a", gsd=0.5), view("b", gsd=0.7), view("c", gsd=2.0))
    assert median_ground_pixel(views, 50.0) == pytest.approx(0.7, rel=1e-3)
    check_resolution(0.06, views, 50.0, "--resolution")
    with pytest.raises(ConfigError, match=r"--resolution 0\.04 m is finer"):
        check_resolution(0.04, views, 50.0, "--resolution")


def test_the_match_scene_of_two_views():
    views = scene(view("n", 2), view("f", 20))
    ties = np.random.default_rng(1).uniform(-20, 20, (60, 3)) + np.array([*CENTRE, 60.0])
    heights = HeightRange.limited_to((30.0, 90.0))
    match_scene = build_match_scene(views, 0.5, (0.0, 0.0), heights, ties, None, PyramidOptions())
    assert match_scene.views[0].name == "n"
    assert match_scene.n_steps == np.ceil(60 / match_scene.height_step)
    assert match_scene.height_origin == 30.0
    assert match_scene.grey_scales == grey_scales(match_scene.views, ties)
    assert match_scene.grey_scales != grey_scales(match_scene.views, ties[:0])
    transform = match_scene.transform(CellWindow(-4, 6, 3, 3), 2)
    assert transform * (0, 0) == (12.0, 8.0)
    assert transform.a == 2.0
    assert transform.e == -2.0


def test_what_is_searched_beyond_the_expected_heights_changes_no_step():
    """The step follows from the ground pixels at the heights expected, whatever else is searched."""
    views, ties = scene(view("n", 2), view("f", 20)), np.empty((0, 3))

    def found(searched):
        heights = HeightRange(expected=(30.0, 90.0), searched=searched)
        return build_match_scene(views, 0.5, (0.0, 0.0), heights, ties, None, PyramidOptions())

    narrow, wide = found((30.0, 90.0)), found((30.0, 20_090.0))
    assert wide.n_steps > 300 * narrow.n_steps
    assert wide.height_step == narrow.height_step
    assert wide.ground_height == narrow.ground_height == 60.0


def scanners(*looks):
    """Line scanners of steady flights, by their angles ahead and aside, degrees, over one place."""
    views = tuple(ViewSpec(str(number), *look) for number, look in enumerate(looks))
    spec = replace(steady(demo_spec()), views=views)
    seen_by = exposures_of(spec)
    return tuple(
        View(each.view.name, Path(each.view.name), image_of(np.zeros(each.shape)), line_scanner(each))
        for each in seen_by
    )


def test_line_scanners_have_the_step_of_satellites():
    """Against the image that looks down, as RPCs of the same cameras would have it, not fore against aft."""
    step = height_step(scanners((2.0, -6.0), (26.0, -6.0), (-14.0, -6.0)), 438.0, 0.2, 0.5)
    slope = np.tan(np.deg2rad(26.0)) - np.tan(np.deg2rad(2.0))
    assert step == pytest.approx(0.5 * 0.208 / slope, rel=0.03)


def test_strips_of_line_scanners_that_look_down_see_heights_between_them():
    """Both see their own middle from straight above, and one place 30 degrees apart."""
    spec = replace(
        steady(demo_spec()), views=tuple(ViewSpec(name, 2.0, side) for name, side in (("a", -15), ("b", 15)))
    )
    views = []
    for each in exposures_of(spec):
        camera = replace(each.sensor, centre=(3000.0, each.sensor.centre[1]))
        wide = replace(each, sensor=camera, shape=(each.shape[0], 6001))
        image = image_of(np.zeros(wide.shape))
        views.append(View(each.view.name, Path(each.view.name), image, line_scanner(wide)))
    assert np.hypot(*(parallax_rate(views[0], 438.0) - parallax_rate(views[1], 438.0))) < 0.02
    step = height_step(tuple(views), 438.0, 0.2, 0.5)
    assert step == pytest.approx(0.5 * 0.208 / (2.0 * np.tan(np.deg2rad(15.0))), rel=0.05)


def test_large_cells_do_not_make_images_look_along_one_line():
    views = (view("a", 10), view("b", -10))
    assert height_step(views, 50.0, 50_000.0, 0.5) == pytest.approx(25_000 / (2 * np.tan(np.deg2rad(10))), rel=1e-3)
