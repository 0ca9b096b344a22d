"""From a scene to corrected pointing and a height range."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import CRS

from orientation_scenes import hill, hill_scene, image_of, observe, rendered, texture, without_translation
from zlocus.core.errors import GeometryError
from zlocus.core.options import BundleAdjustmentOptions, OrientationOptions
from zlocus.core.scene import Scene, View
from zlocus.orientation.orientation import Orientation, OrientationRequest, orient
from zlocus.orientation.tie_heights import height_range_of_ties
from zlocus.orientation.tie_refinement import RefinedTies
from zlocus.orientation.triangulate import Observations, project_points
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.frame import FrameModel
from zlocus.sensors.rpc import RpcCoefficients, RpcModel

OPTIONS = OrientationOptions(features_per_mpx=20000)
PLANTED = np.array([(0.0, 0.0), (3.0, -8.0), (-5.0, 4.0)])
SHIFT_TOLERANCE_PX = 0.1


def height_range(orientation, options):
    names = [view.name for view in orientation.views]
    return height_range_of_ties(orientation.xyz, orientation.sigma_z_m, names, options)


@pytest.fixture(scope="module")
def scene():
    return hill_scene(PLANTED.tolist())


@pytest.fixture(scope="module")
def oriented(scene):
    return orient(scene, OPTIONS)


def test_planted_pointing_errors_are_taken_back(scene, oriented):
    shift = np.array([v.shift_px for v in oriented.views])
    assert np.abs(without_translation(shift + PLANTED, [v.sensor for v in scene.views])).max() < SHIFT_TOLERANCE_PX
    for view in oriented.views:
        assert view.n_ties > 100
        assert view.residuals_before.rms > 1.0
        assert view.residuals_after.median <= view.residuals_after.rms < 0.3
        assert view.residuals_after.median < view.residuals_before.median
    for pair in oriented.pairs:
        assert pair.epipolar_distance_after_px < 0.3 < pair.epipolar_distance_before_px


def test_ties_that_are_known_make_the_same_orientation(scene, oriented, monkeypatch):
    def looked_for(*_):
        raise AssertionError("ties are looked for again")

    for name in ("find_ties", "refine_ties"):
        monkeypatch.setattr(f"zlocus.orientation.orientation.{name}", looked_for)
    known = RefinedTies.of(oriented.refined_ties.arrays(), len(scene.views))
    again = orient(scene, OPTIONS, OrientationRequest(refined_ties=known))
    assert again.as_dict() == oriented.as_dict()
    assert again.z_bounds == oriented.z_bounds
    np.testing.assert_array_equal(again.xyz, oriented.xyz)
    np.testing.assert_array_equal(again.observations.xy, oriented.observations.xy)


@pytest.mark.parametrize(
    "change",
    [
        lambda kept: kept.pop("rough_xy"),
        lambda kept: kept.update(z_range=np.zeros(3)),
        lambda kept: kept.update(precise_view=kept["precise_view"] + 1),
        lambda kept: kept.update(precise_point=kept["precise_point"][:-1]),
        lambda kept: kept.update(rough_point=-1 - kept["rough_point"]),
        lambda kept: kept.update(rough_xy=kept["rough_xy"][:, :1]),
        lambda kept: kept.update(z=kept["z"][:-1]),
        lambda kept: kept.update(rough_view=kept["rough_view"].astype(float)),
    ],
)
def test_arrays_that_are_no_ties_of_the_scene_are_none(scene, oriented, change):
    kept = oriented.refined_ties.arrays()
    assert RefinedTies.of(kept, len(scene.views)) is not None
    change(kept)
    assert RefinedTies.of(kept, len(scene.views)) is None


def test_applied_shifts_are_the_reported_ones(scene, oriented):
    corrected = oriented.apply(scene)
    xyz = oriented.xyz[:5]
    for old, new, found in zip(scene.views, corrected.views, oriented.views, strict=True):
        moved = new.sensor.image_from_ground(xyz) - old.sensor.image_from_ground(xyz)
        assert np.abs(moved - found.shift_px).max() < 1e-9
    again = orient(corrected, OPTIONS)
    assert np.abs([v.shift_px for v in again.views]).max() < SHIFT_TOLERANCE_PX / 2
    assert height_range(again, OPTIONS).searched == pytest.approx(height_range(oriented, OPTIONS).searched, abs=3.0)


def test_the_report_is_plain_and_says_what_was_not_applied(oriented):
    report = json.loads(json.dumps(oriented.as_dict()))
    assert list(report["views"]) == ["view0", "view1", "view2"]
    assert set(report["views"]["view1"]) == {
        "sensor", "shift_px", "n_ties", "residual_before_px", "residual_after_px",
        "line_shifts_px",
    }  # fmt: skip
    assert report["pairs"][0]["views"] == ["view0", "view1"]
    assert "3 of the 6" in report["unobservable"]


def test_no_correction_is_said_and_nothing_moves(scene):
    found = orient(scene, replace(OPTIONS, model="none"))
    assert all(a is b for a, b in zip(found.apply(scene).views, scene.views, strict=True))
    assert "No correction" in found.as_dict()["unobservable"]
    assert len(found.xyz) > 100


def turned_frames():
    """Frame cameras above the hill that look at its middle, and the same with errors of their poses."""
    exact = []
    for x, y in ((0.0, 0.0), (250.0, 30.0), (-200.0, 150.0)):
        forwards = np.array([-x, -y, -900.0]) / np.hypot(np.hypot(x, y), 900.0)
        right = np.cross(forwards, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        rows = tuple(map(tuple, np.array([right, np.cross(forwards, right), forwards])))
        exact.append(FrameModel((x, y, 1000.0), rows, 1800.0, (140.0, 140.0)))
    rng = np.random.default_rng(2)
    return exact, [c.corrected(rng.normal(0, 0.5, 3), np.deg2rad(rng.normal(0, 0.1, 3))) for c in exact]


def test_frame_cameras_are_corrected_jointly():
    """Poses, not images, are corrected, and on the ground what is left is a motion of everything together."""
    coefficients, views = texture(), []
    for i, (exact, flawed) in enumerate(zip(*turned_frames(), strict=True)):
        views.append(View(f"view{i}", Path(f"view{i}.tif"), image_of(rendered(exact, 280, coefficients)), flawed))
    scene = Scene(tuple(views), CRS.from_epsg(32631), heights=(60.0, 180.0))
    found = orient(scene, replace(OPTIONS, bundle_adjustment=BundleAdjustmentOptions(sigma_attitude_deg=0.1)))
    assert found.model == "joint"
    assert {view.sensor for view in found.views} == {"frame"}
    corrected = found.apply(scene)
    assert all(isinstance(view.sensor, FrameModel) for view in corrected.views)
    for view in found.views:
        assert view.n_ties > 100
        assert view.residuals_before.rms > 0.5
        assert view.residuals_after.rms < 0.3
    for pair in found.pairs:
        assert pair.epipolar_distance_after_px < 0.3 < pair.epipolar_distance_before_px
    xyz, sensors = found.refined_xyz, [view.sensor for view in corrected.views]
    assert np.median(np.abs(xyz[:, 2] - hill(*xyz[:, :2].T) - np.median(xyz[:, 2] - hill(*xyz[:, :2].T)))) < 0.5
    seen = found.observations.kept(found.observations.point < found.n_refined)
    assert np.median(np.hypot(*(project_points(sensors, seen, found.xyz) - seen.xy).T)) < 0.3
    shift = orient(scene, replace(OPTIONS, model="shift"))
    assert (shift.model, shift.bundle_adjustment) == ("shift", None)
    assert "directions" in found.as_dict()["unobservable"]


def test_an_image_that_shares_nothing_is_named(scene):
    blank = replace(scene.views[2], image=image_of(np.full((280, 280), 5.0)))
    found = orient(replace(scene, views=(*scene.views[:2], blank)), OPTIONS)
    assert found.views[2].shift_px == (0.0, 0.0)
    assert found.views[2].n_ties == 0
    assert "view2" in found.unobservable
    assert (
        json.loads(json.dumps(found.as_dict(), allow_nan=False))["views"]["view2"]["residual_after_px"]["rms"] is None
    )


def test_nothing_in_common_gives_no_range():
    scene = hill_scene([(0.0, 0.0), (0.0, 0.0)], size=96)
    blank = tuple(replace(v, image=image_of(np.full((96, 96), 5.0))) for v in scene.views)
    found = orient(replace(scene, views=blank), OPTIONS)
    with pytest.raises(GeometryError, match=r"Only 0 .*view0, view1.*--heights"):
        height_range(found, OPTIONS)


def ground(xyz, sigma_m=0.3):
    """An orientation that knows ground points only."""
    seen = Observations(np.empty(0, int), np.empty(0, int), np.empty((0, 2)))
    return Orientation((), (), xyz, np.full(len(xyz), sigma_m), seen, "shift", 0, (0.0, 1000.0), len(xyz))


def test_the_range_keeps_a_tower_and_drops_lone_wrong_heights():
    rng = np.random.default_rng(2)
    xy = rng.uniform(0, 500, (2000, 2))
    plain = np.column_stack([xy, 100.0 + 0.05 * xy[:, 0]])
    tower = np.column_stack([rng.uniform(240, 260, (25, 2)), np.full(25, 160.0)])
    wrong = np.column_stack([rng.uniform(0, 500, (60, 2)), rng.uniform(0, 1000, 60)])
    found = height_range(ground(np.vstack([plain, tower, wrong])), OPTIONS)
    assert 75.0 < found.expected[0] < 100.0
    assert 160.0 < found.expected[1] < 190.0
    assert found.searched == pytest.approx((found.expected[0] - 18.0, found.expected[1] + 130.0))


def test_the_margins_are_those_of_the_options():
    xy = np.random.default_rng(2).uniform(0, 500, (3000, 2))
    flat = ground(np.column_stack([xy, 100.0 + 0.1 * xy[:, 0]]))
    bare = replace(OPTIONS, range_margin=0.0, range_up_m=0.0, range_down_m=0.0)
    low, high = height_range(flat, bare).expected
    assert (low, high) == pytest.approx((100.25, 149.75), abs=0.3)
    wide = height_range(
        flat,
        replace(bare, range_margin=0.5, range_up_m=7.0, range_down_m=2.0, search_up_m=11.0, search_down_m=3.0),
    )
    expected = (low - (high - low) / 2 - 2.0, high + (high - low) / 2 + 7.0)
    assert wide.expected == pytest.approx(expected)
    assert wide.searched == pytest.approx((expected[0] - 3.0, expected[1] + 11.0))


def test_too_few_ties_are_no_range():
    xyz = np.column_stack([np.random.default_rng(0).uniform(0, 30, (19, 2)), np.full(19, 100.0)])
    with pytest.raises(GeometryError, match="Only 19"):
        height_range(ground(xyz), OPTIONS)


def rendered_scene(folder, names, epsg):
    """Views of a shared scene, with nothing but rasterio."""
    crs, views = CRS.from_epsg(epsg), []
    for name in names:
        with rasterio.open(folder / f"img_{name}.tif") as file:
            pixels, tags = file.read(1), file.rpcs
        scalars = ("line_off", "samp_off", "lat_off", "long_off", "height_off", "line_scale", "samp_scale", "lat_scale",
                   "long_scale", "height_scale")  # fmt: skip
        tables = ("line_num_coeff", "line_den_coeff", "samp_num_coeff", "samp_den_coeff")
        rpc = RpcCoefficients(*(getattr(tags, s) for s in scalars), *(tuple(getattr(tags, t)) for t in tables))
        views.append(View(name, folder / f"img_{name}.tif", image_of(pixels), RpcModel(rpc, crs)))
    return Scene(tuple(views), crs)


def test_rendered_hills_with_wrong_pointing(shared_data):
    """Six views, errors up to 4 px in their RPCs: what remains after a fit of one ground translation."""
    folder = shared_data / "rendered-hills-biased"
    scene = rendered_scene(folder, ("n1", "f1", "b1", "n2", "f2", "b2"), 32632)
    truth = json.loads((folder / "scene.json").read_text())
    planted = np.array([truth["views"][v.name]["bias_row_col"][::-1] for v in scene.views])
    found = orient(scene, OrientationOptions())
    shift = np.array([v.shift_px for v in found.views])
    assert np.abs(after_ground_translation(shift + planted, scene, found.xyz.mean(axis=0))).max() < SHIFT_TOLERANCE_PX
    low, high = height_range(found, OrientationOptions()).expected
    assert truth["zmin"] - 60.0 < low < truth["zmin"]
    assert truth["zmax"] < high < truth["zmax"] + 60.0


def after_ground_translation(shift, scene, at):
    """Shifts (i, 2) px less the best fitting effect of a common translation of the ground."""
    moves = np.vstack([np.zeros(3), np.eye(3)]) + at
    effect = np.concatenate([np.diff(v.sensor.image_from_ground(moves)[[0, k]], axis=0).T for v in scene.views
                             for k in (1, 2, 3)], axis=1)  # fmt: skip
    effect = effect.reshape(2, len(scene.views), 3).transpose(1, 0, 2).reshape(-1, 3)
    return shift.ravel() - effect @ np.linalg.lstsq(effect, shift.ravel(), rcond=None)[0]


def test_heights_of_a_pair_do_not_move():
    """Two images: an error along the locus is a height, and stays one."""
    scene = hill_scene([(0.0, 0.0), (4.0, 0.0)], looks=((0.0, 0.0), (0.3, 0.0)), turn_deg=(0.0, 0.0))
    found = orient(scene, OPTIONS)
    assert "1 of the 4" in found.unobservable
    assert np.abs([v.shift_px for v in found.views]).max() < SHIFT_TOLERANCE_PX
    exact = [view.sensor.base_sensor for view in scene.views]
    seen = observe(exact, found.xyz[:1])
    assert len(seen) == 2
    assert isinstance(scene.views[1].sensor, ShiftedModel)
    raised = 4.0 * 0.5 / 0.3  # metres of height that 4 px along the locus amount to
    above = found.xyz[:, 2] - 100.0 - 20.0 * np.exp(-(found.xyz[:, 0] ** 2 + found.xyz[:, 1] ** 2) / (2 * 40.0**2))
    assert abs(np.median(above)) == pytest.approx(raised, rel=0.1)
