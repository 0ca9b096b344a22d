"""Image space: scenes in the frame of one of their images, their lattices, and options."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS

from rendered_scenes import UTM, camera
from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.options import CostOptions, OrientationOptions, PyramidOptions, RunConfig, large_window_side
from zlocus.core.options.option_fields import value_of
from zlocus.core.scene import ImageWindow, Scene, View
from zlocus.matching.image_space import (
    BORDER_PX,
    END_STEPS,
    BorderedImage,
    beyond_range,
    build_image_match_scene,
    depth_options,
    fitting_block,
    hypotheses_of_heights,
    hypotheses_of_ties,
    image_space,
    shift_rates,
    widest_disparities,
)
from zlocus.sensors.frame import FrameModel, rotation_from_angles

LEVEL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
NO_TIES = np.zeros((0, 3))


@dataclass(frozen=True)
class Ramp:
    """Pixels that count themselves."""

    shape: tuple[int, int] = (60, 80)
    dtype: str = "float32"

    def read(self, row: int, col: int, rows: int, cols: int) -> ImageWindow:
        whole = np.arange(self.shape[0] * self.shape[1], dtype=np.float32).reshape(self.shape)
        assert row >= 0
        assert col >= 0
        part = whole[row : row + rows, col : col + cols]
        assert part.shape == (rows, cols)
        return ImageWindow(part, part % 7 != 0)


def view(name: str, sensor) -> View:
    return View(name, Path(f"{name}.tif"), Ramp(), sensor)


def row_of_frames(*places: float) -> Scene:
    """Cameras along x that look along z."""
    views = [view(f"v{k}", FrameModel((x, 0.0, 0.0), LEVEL, 400.0, (40.0, 30.0))) for k, x in enumerate(places)]
    return Scene(tuple(views), CRS.from_epsg(32632))


def satellites() -> Scene:
    return Scene(tuple(view(name, camera(name, 60)) for name in ("nadir", "fore", "aft")), UTM)


def test_disparities_are_those_of_the_longest_base():
    space = image_space(row_of_frames(0.0, 1.0, 3.0), "v1", (0.0, 0.0))
    assert [v.name for v in space.views] == ["v1", "v0", "v2"]
    xyz = np.array([[1.0, 0.0, 40.0]])
    np.testing.assert_allclose(space.frame_from_ground(xyz), [[40.0, -30.0, 400.0 * 2.0 / 40.0]])


def test_a_step_is_half_a_pixel_in_the_most_sensitive_image():
    space = image_space(row_of_frames(0.0, 1.0, 3.0), "v0", (0.0, 0.0))
    match_scene = build_image_match_scene(space, (4.0, 20.0), NO_TIES, PyramidOptions())
    assert match_scene.height_step == pytest.approx(0.5)
    assert match_scene.height_origin == pytest.approx(4.0 - END_STEPS * 0.5)
    assert match_scene.n_steps == 32 + 2 * END_STEPS
    assert (match_scene.overlap_window.row, match_scene.overlap_window.col) == (0, 0)
    assert match_scene.overlap_window.rows >= 60
    assert match_scene.overlap_window.cols >= 80
    # A third of the base, a third of the shift.
    rates = shift_rates(space, space.views[1], 12.0)
    np.testing.assert_allclose(rates[np.isfinite(rates)], 1 / 3, atol=1e-9)


def test_satellites_are_asked_for_heights_in_ground_pixels():
    space = image_space(satellites(), "nadir", (40.0, 60.0))
    assert hypotheses_of_heights(space, (40.0, 60.0)) == pytest.approx((-20.0, 20.0), rel=0.02)
    match_scene = build_image_match_scene(space, (-20.0, 20.0), NO_TIES, PyramidOptions())
    # The aft image looks 18 degrees apart along the track and 7 across: a ground pixel of height shifts it so much.
    along, across = np.tan(np.deg2rad([1.0, -3.0])) - np.tan(np.deg2rad([-17.0, 4.0]))
    assert match_scene.height_step == pytest.approx(0.5 / np.hypot(along, across), rel=0.05)


def test_the_first_pixel_is_the_first_cell():
    space = image_space(satellites(), "fore", (40.0, 60.0))
    match_scene = build_image_match_scene(space, (-20.0, 20.0), NO_TIES, PyramidOptions())
    x, y = match_scene.transform(match_scene.overlap_window, 0) * (0.5, 0.5)
    np.testing.assert_allclose(match_scene.views[0].sensor.image_from_ground(np.array([[x, y, 3.0]])), BORDER_PX)


def test_heights_limit_depths_where_every_ray_meets_them():
    space = image_space(row_of_frames(0.0, 2.0), "v0", (0.0, 0.0))
    assert hypotheses_of_heights(space, (20.0, 400.0)) == pytest.approx((2.0, 40.0))
    level_camera = FrameModel((0.0, 0.0, 0.0), rotation_from_angles(90.0, 0.0, 0.0), 400.0, (40.0, 30.0))
    views = (view("a", level_camera), view("b", replace(level_camera, centre=(2.0, 0.0, 0.0))))
    assert hypotheses_of_heights(image_space(Scene(views, UTM), "a", (0.0, 0.0)), (-5.0, 5.0)) is None


def test_ties_give_the_range_of_disparities():
    space = image_space(row_of_frames(0.0, 2.0), "v0", (0.0, 0.0))
    ties = np.column_stack([np.zeros((101, 2)), np.linspace(30.0, 130.0, 101)])
    low, high = hypotheses_of_ties(space, ties, OrientationOptions(range_margin=0.1))
    assert (low, high) == pytest.approx((30.5 - 9.9 - 8.0, 129.5 + 9.9 + 8.0))
    assert hypotheses_of_ties(space, ties - [0, 0, 25.0], OrientationOptions())[0] == 0.5
    with pytest.raises(GeometryError, match=r"v0.*--heights"):
        hypotheses_of_ties(space, ties[:19], OrientationOptions())


def test_the_added_steps_hold_no_heights():
    space = image_space(row_of_frames(0.0, 2.0), "v0", (0.0, 0.0))
    match_scene = build_image_match_scene(space, (4.0, 20.0), NO_TIES, PyramidOptions())
    heights = np.array([[3.0, 3.8, 4.0, 12.0, 20.2, 20.5, np.nan]], np.float32)
    np.testing.assert_array_equal(beyond_range(match_scene, heights), [[True, False, False, False, False, True, False]])


def test_borders_repeat_the_outermost_pixels():
    image = BorderedImage(Ramp(), 2)
    assert image.shape == (64, 84)
    whole, plain = image.read(0, 0, 64, 84), Ramp().read(0, 0, 60, 80)
    np.testing.assert_array_equal(whole.pixels, np.pad(plain.pixels, 2, mode="edge"))
    np.testing.assert_array_equal(whole.valid, np.pad(plain.valid, 2, mode="edge"))
    np.testing.assert_array_equal(image.read(61, 1, 3, 10).pixels, whole.pixels[61:64, 1:11])


def test_turned_images_are_tabulated_in_smaller_blocks():
    straight = build_image_match_scene(
        image_space(row_of_frames(0.0, 2.0), "v0", (0.0, 0.0)), (4.0, 20.0), NO_TIES, PyramidOptions()
    )
    assert fitting_block([straight], 32) == 32
    turned = FrameModel((2.0, 0.0, 0.0), rotation_from_angles(180.0, 9.0, 0.0), 400.0, (40.0, 30.0))
    views = (row_of_frames(0.0).views[0], view("t", turned))
    space = image_space(Scene(views, UTM), "v0", (0.0, 0.0))
    match_scene = build_image_match_scene(space, (10.0, 40.0), NO_TIES, PyramidOptions())
    assert fitting_block([match_scene], 32) in (8, 16)
    # Beyond what is in front of both cameras nothing helps.
    assert fitting_block([replace(match_scene, height_origin=-2000.0, n_steps=8000)], 32) is None


def test_the_widest_search_ends_where_no_other_view_sees():
    # 80 columns, so at a disparity of 79 px one is left.
    low, high = widest_disparities(image_space(row_of_frames(0.0, 2.0), "v0", (0.0, 0.0)))
    assert low == 0.0
    assert 66.0 < high < 80.0


def test_options_that_were_changed_stay():
    plain = depth_options(RunConfig())
    assert (plain.cost.large_window, plain.cost.occluded_pairs_excluded, plain.cost.occlusion_margin_steps) == (
        3,
        1,
        24,
    )
    assert (plain.semiglobal.predecessors, plain.semiglobal.p1, plain.semiglobal.p2) == (1, 20, 240)
    assert (plain.planes.min_share_below, plain.planes.max_cost_increase) == (0.0, 0.05)
    for value in (0.25, value_of(CostOptions(), "occluded_pairs_excluded")):
        mine = RunConfig(cost=CostOptions(occluded_pairs_excluded=value))
        assert depth_options(mine).cost.occluded_pairs_excluded == value
        assert depth_options(mine).cost.large_window == 3


@pytest.mark.parametrize("side", [3, 5, 7])
def test_a_large_window_that_the_user_set_stays_whatever_its_value(side):
    assert depth_options(RunConfig(cost=CostOptions(large_window=side))).cost.large_window == side


def test_an_unset_large_window_is_decided_by_the_method():
    unset = RunConfig()
    assert unset.cost.large_window is None
    assert large_window_side(unset.cost) == 5, "on the ground grid"
    assert large_window_side(depth_options(unset).cost) == 3, "for depths in image space"
    assert large_window_side(CostOptions(large_window=7)) == 7


def test_what_makes_no_image_space_is_refused():
    with pytest.raises(ConfigError, match=r"--reference v9 .* v0, v1"):
        image_space(row_of_frames(0.0, 1.0), "v9", (0.0, 0.0))
    with pytest.raises(GeometryError, match="one place"):
        image_space(row_of_frames(0.0, 0.0), "v0", (0.0, 0.0))
    far = image_space(row_of_frames(0.0, 1.0), "v0", (0.0, 0.0))
    with pytest.raises(GeometryError, match=r"v0.*overlap"):
        build_image_match_scene(far, (300.0, 400.0), NO_TIES, PyramidOptions())
