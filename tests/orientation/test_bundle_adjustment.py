"""Cameras of every kind corrected jointly: planted errors, the datum, control, outliers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bundle_scenes import (
    AFFINE_SIZE,
    FRAME_SIZE,
    SCAN_COLUMNS,
    SCAN_ROWS,
    affine_sensors,
    control_of,
    first_points,
    flawed_frames,
    flight_of_frames,
    frame_ground,
    scan_ground,
    seen_by,
    strips_of_lines,
    views_of,
)
from orientation_scenes import random_ground, without_translation
from zlocus.core.options import BundleAdjustmentOptions, OrientationOptions
from zlocus.orientation.bundle_adjustment import adjust_bundle
from zlocus.orientation.control import GroundControl, TerrainHeights
from zlocus.orientation.parameter_groups import (
    DRIFT,
    FOCAL,
    POSE,
    SHIFT,
    kind_of,
    needs_bundle_adjustment,
    parameter_groups_of,
)
from zlocus.orientation.shift_adjustment import adjust
from zlocus.orientation.triangulate import project_points
from zlocus.sensors.correction import AffinelyShiftedModel, ShiftedModel
from zlocus.sensors.trajectory import Drift

OPTIONS = OrientationOptions()
# Control points measured as exactly as the ties, and priors that the planted errors fit.
EXACT = BundleAdjustmentOptions(sigma_control_px=0.01, sigma_position_m=1.0, sigma_attitude_deg=0.05)
SCAN_SIZE = (SCAN_COLUMNS, SCAN_ROWS)
# Exact ties: what is left is the pull of the priors, which hold cameras against errors that all ties share.
RECOVERED_PX = 0.05
DATUM_M = 1e-3


def oriented(exact, flawed, xyz, size, options=None, noise_px=0.0, **more):
    """What the flawed cameras become, from what the exact ones see."""
    options = options or OrientationOptions(bundle_adjustment=EXACT)
    seen, xyz = seen_by(exact, xyz, size, noise_px)
    return adjust_bundle(views_of(flawed, size), seen, first_points(flawed, seen, xyz), options, **more), xyz


def image_errors(found, exact, xyz):
    """(i, n) px by which each corrected camera puts ground points wrong, where the exact one sees them."""
    errors = [
        np.hypot(*(a.image_from_ground(xyz) - b.image_from_ground(xyz)).T)
        for a, b in zip(found.sensors, exact, strict=True)
    ]
    return np.array(errors)


def frames(options=None, noise_px=0.0, n=600, **more):
    exact = flight_of_frames()
    options = options or OrientationOptions(bundle_adjustment=EXACT)
    return *oriented(exact, flawed_frames(exact), frame_ground(n), FRAME_SIZE, options, noise_px, **more), exact


def frame_control(**more):
    return control_of(flight_of_frames(), frame_ground(12, seed=21) * [0.6, 0.6, 1.0], FRAME_SIZE, **more)


def test_poses_of_frame_cameras_are_recovered_with_control():
    found, xyz, exact = frames(control=frame_control())
    assert np.median(np.hypot(*found.adjustment.before_px.T)) > 1.0
    assert np.nanmax(image_errors(found, exact, xyz)) < RECOVERED_PX
    assert found.solution.n_determined == 48 - 7


def test_the_datum_stays_where_positions_put_it():
    """A common motion of cameras and ground cannot be seen: the mean correction of the centres is zero; rays meet."""
    found, _, _ = frames()
    moved = np.array([s.centre for s in found.sensors]) - [s.centre for s in flawed_frames(flight_of_frames())]
    assert np.abs(moved).max() > 0.1
    assert np.abs(moved.mean(axis=0)).max() < DATUM_M
    assert np.hypot(*found.adjustment.after_px.T).max() < RECOVERED_PX


def test_sigma0_is_the_noise_of_an_image_coordinate():
    found, _, _ = frames(noise_px=0.3)
    assert found.solution.sigma0_px == pytest.approx(0.3, rel=0.1)


def test_exact_cameras_stay_as_delivered():
    """The noise of ties does not become corrections."""
    exact = flight_of_frames()
    found, _ = oriented(exact, exact, frame_ground(600), FRAME_SIZE, OPTIONS, noise_px=0.3)
    assert found.sensors == tuple(exact)
    assert found.solution.is_held.all()
    moved, _, _ = frames(noise_px=0.3)
    assert not moved.solution.is_held.any()


def test_a_kind_of_correction_that_no_tie_asks_for_is_not_made():
    """Positions are wrong, attitudes and one image's shift are not."""
    exact = flight_of_frames()
    rng = np.random.default_rng(3)
    wrong = [camera.corrected(rng.normal(0.0, 0.5, 3), np.zeros(3)) for camera in exact]
    options = OrientationOptions(bundle_adjustment=replace(EXACT, sigma_attitude_deg=1e-3))
    found, _ = oriented(exact, wrong, frame_ground(600), FRAME_SIZE, options, 0.1)
    assert found.solution.is_held.reshape(8, 6).tolist() == [[False] * 3 + [True] * 3] * 8


def test_the_focal_length_is_found_on_request():
    exact = flight_of_frames()
    wrong = [replace(camera, focal=camera.focal + 8.0) for camera in exact]
    ground = frame_ground(600, relief_m=400.0)
    fixed, xyz = oriented(exact, wrong, ground, FRAME_SIZE, control=frame_control())
    assert np.nanmax(image_errors(fixed, exact, xyz)) > 0.5
    options = OrientationOptions(bundle_adjustment=replace(EXACT, self_calibration=("focal",), sigma_focal_px=20.0))
    found, xyz = oriented(exact, wrong, ground, FRAME_SIZE, options, control=frame_control())
    assert [sensor.focal for sensor in found.sensors] == pytest.approx([6000.0] * 8, abs=0.1)
    assert np.nanmax(image_errors(found, exact, xyz)) < RECOVERED_PX
    (focal,) = [group for group in found.groups if group.kind == FOCAL]
    assert focal.views == tuple(range(8))


def test_a_drift_of_line_scanners_is_recovered():
    """Slow errors of 0.5 m and 0.02 degrees, other ones at every knot, shared by the lines of a strip."""
    exact = strips_of_lines()
    rng = np.random.default_rng(5)
    start, end = exact[0].lines.times[[0, -1]]
    flawed = []
    for strip in range(2):
        values = rng.standard_normal((3, 6)) * ([0.5] * 3 + [np.deg2rad(0.02)] * 3)
        drift = Drift(np.linspace(start, end, 3), values)
        flawed += [sensor.corrected(drift) for sensor in exact[3 * strip : 3 * strip + 3]]
    options = OrientationOptions(bundle_adjustment=replace(EXACT, drift_knot_interval_s=20.0))
    control = control_of(exact, scan_ground(10, 3), SCAN_SIZE)
    found, xyz = oriented(exact, flawed, scan_ground(200), SCAN_SIZE, options, control=control)
    assert [group.kind for group in found.groups] == [DRIFT] * 2
    assert [group.views for group in found.groups] == [(0, 1, 2), (3, 4, 5)]
    assert [len(group) for group in found.groups] == [18, 18]
    before = [a.image_from_ground(xyz) - b.image_from_ground(xyz) for a, b in zip(flawed, exact, strict=True)]
    assert np.nanmedian(np.abs(before)) > 1.0
    assert np.nanmax(image_errors(found, exact, xyz)) < RECOVERED_PX


def test_affine_errors_of_rpcs_are_recovered_with_control():
    exact = affine_sensors()
    rng = np.random.default_rng(6)
    flawed = [
        AffinelyShiftedModel(s, *map(tuple, np.column_stack([rng.normal(0, 3, 2), rng.normal(0, 2e-3, (2, 2))])))
        for s in exact
    ]
    options = OrientationOptions(bundle_adjustment=replace(EXACT, rpc_correction="affine"))
    control = control_of(exact, random_ground(8, seed=4), AFFINE_SIZE)
    found, xyz = oriented(exact, flawed, random_ground(300), AFFINE_SIZE, options, control=control)
    assert np.nanmax(image_errors(found, exact, xyz)) < RECOVERED_PX
    shifted, xyz = oriented(exact, flawed, random_ground(300), AFFINE_SIZE, control=control)
    assert np.nanmax(image_errors(shifted, exact, xyz)) > 10 * RECOVERED_PX


SHIFTS = np.array([[2.0, -3.0], [-4.0, 1.0], [0.5, 5.0], [1.0, 1.0]])


def shifted_block(n_views, n=300, noise_px=0.2):
    exact = affine_sensors()[:n_views]
    flawed = [ShiftedModel(s, -column, -row) for s, (column, row) in zip(exact, SHIFTS, strict=False)]
    seen, xyz = seen_by(exact, random_ground(n), AFFINE_SIZE, noise_px)
    return flawed, seen, xyz


@pytest.mark.parametrize("n_views", [2, 3, 4])
def test_shifts_are_those_of_the_adjustment_of_shifts(n_views):
    """Two solvers that share no algebra; with two images nothing moves along the loci in either."""
    flawed, seen, xyz = shifted_block(n_views)
    alone = adjust(flawed, seen, xyz, OPTIONS)
    found = adjust_bundle(views_of(flawed, AFFINE_SIZE), seen, xyz, OPTIONS)
    assert {group.kind for group in found.groups} == {SHIFT}
    assert found.solution.n_determined == alone.n_determined
    np.testing.assert_allclose(
        found.solution.parameters.reshape(-1, 2) * OPTIONS.sigma_shift_px, alone.shift_px, atol=2e-3
    )


def test_wrong_ties_are_dropped():
    flawed, seen, xyz = shifted_block(4)
    rng = np.random.default_rng(4)
    wrong = rng.choice(len(seen), len(seen) // 20, replace=False)
    seen.xy[wrong] += rng.uniform(-60.0, 60.0, (len(wrong), 2))
    found = adjust_bundle(views_of(flawed, AFFINE_SIZE), seen, xyz, OPTIONS)
    left = found.solution.parameters.reshape(-1, 2) * OPTIONS.sigma_shift_px - SHIFTS
    assert np.abs(without_translation(left, flawed)).max() < 0.05
    assert len(found.adjustment.observations) < len(seen) - 0.8 * len(wrong)
    assert np.hypot(*found.adjustment.after_px.T).max() < 2.0


def test_control_fixes_the_datum():
    """All cameras 0.8 m off in the same direction: ties see nothing, control does."""
    exact = flight_of_frames()
    common = np.array([0.8, -0.5, 0.6])
    flawed = [replace(camera, centre=tuple(np.array(camera.centre) + common)) for camera in exact]
    for control, expected in ((None, common), (frame_control(), np.zeros(3))):
        found, xyz = oriented(exact, flawed, frame_ground(400), FRAME_SIZE, control=control)
        error = found.adjustment.ground_points.xyz - xyz[found.adjustment.numbers]
        np.testing.assert_allclose(error.mean(axis=0), expected, rtol=0, atol=0.02)


def test_check_points_judge_and_have_no_say():
    role = np.arange(12) % 2 == 1
    moved = np.zeros((12, 3))
    found, _, _ = frames(control=frame_control(is_check=role))
    moved[role] = [3.0, -2.0, 5.0]
    again, _, _ = frames(control=frame_control(is_check=role, moved=moved))
    np.testing.assert_array_equal(again.solution.parameters, found.solution.parameters)
    error = found.control_points - found.control.xyz
    assert np.abs(error).max() < 0.02
    np.testing.assert_allclose((again.control_points - again.control.xyz)[role], error[role] - moved[role], atol=1e-6)
    # A control point has a say.
    moved = np.where(role[:, None], 0.0, [0.0, 0.0, 0.5])
    raised, _, _ = frames(control=frame_control(is_check=role, moved=moved))
    assert (raised.control_points - raised.control.xyz)[role][:, 2] == pytest.approx(0.5, abs=0.05)


def test_terrain_heights_hold_the_ground_up():
    """Cameras a metre too high, and every fourth tie on a tree 12 m above the terrain."""
    exact = flight_of_frames()
    flawed = [replace(camera, centre=(*camera.centre[:2], camera.centre[2] + 1.0)) for camera in exact]
    col, row = np.meshgrid(np.arange(50.0), np.arange(50.0))
    terrain = TerrainHeights(60.0 + col - 0.5 * row, -2000.0, 2000.0, 80.0)
    xyz = frame_ground(800)
    xyz[:, 2] = terrain.at(xyz[:, :2])[0] + 12.0 * (np.arange(800) % 4 == 0)
    options = OrientationOptions(bundle_adjustment=BundleAdjustmentOptions(sigma_dem_m=0.5))
    for given, expected in ((None, 1.0), (terrain, 0.0)):
        found, seen_xyz = oriented(exact, flawed, xyz, FRAME_SIZE, options, terrain=given)
        error = (found.adjustment.ground_points.xyz - seen_xyz[found.adjustment.numbers])[:, 2]
        assert error.mean() == pytest.approx(expected, abs=0.15)
    assert np.median(found.terrain_m) == pytest.approx(0.0, abs=0.15)


def test_many_ties_do_not_move_cameras_that_they_hardly_hold():
    """Narrow fields from far above, and a small error that grows over the images: taken at their word, 6000 image
    points would turn the cameras by 0.37 sigma, and the ground would sink by 28 m."""
    exact = [replace(c, centre=(*c.centre[:2], 15_000.0), focal=60_000.0) for c in flight_of_frames(1, 3)]
    seen, xyz = seen_by(exact, frame_ground(3000), FRAME_SIZE, noise_px=0.1)
    seen.xy[:, 1] += 0.1 * ((seen.xy[:, 0] - 3000.0) / 3000.0) ** 2 * (seen.view - 1)
    found = adjust_bundle(views_of(exact, FRAME_SIZE), seen, xyz, OPTIONS)
    assert np.abs(found.solution.parameters).max() < 0.1
    assert abs(np.median(found.adjustment.ground_points.xyz[:, 2] - xyz[found.adjustment.numbers, 2])) < 6.0


def test_an_affine_correction_there_and_back():
    model = AffinelyShiftedModel(affine_sensors()[1], (3.0, 0.1, -0.2), (-5.0, 0.05, 0.15))
    xy = np.random.default_rng(1).uniform(0, 800, (50, 2))
    xyz = model.ground_from_image(xy, np.linspace(100.0, 160.0, 50))
    np.testing.assert_allclose(model.image_from_ground(xyz), xy, rtol=0, atol=1e-9)
    base = model.base_sensor.image_from_ground(xyz)
    np.testing.assert_allclose(xy - base, [[3.0, -5.0]] + base @ np.array([[0.1, 0.05], [-0.2, 0.15]]), atol=1e-9)


def test_every_kind_of_sensor_at_once():
    frames_, scanners, satellites = flight_of_frames(1, 2), strips_of_lines((0.0,)), affine_sensors()[:1]
    views = views_of([*frames_, *scanners, *satellites], AFFINE_SIZE)
    assert [kind_of(view.sensor) for view in views] == ["frame"] * 2 + ["linescan"] * 3 + ["other"]
    groups = parameter_groups_of(views, OPTIONS)
    assert [(group.kind, group.views) for group in groups] == [
        (SHIFT, (5,)), (POSE, (0,)), (POSE, (1,)), (DRIFT, (2, 3, 4)),
    ]  # fmt: skip
    assert [needs_bundle_adjustment(views), needs_bundle_adjustment(views[5:])] == [True, False]


def test_frames_and_a_satellite_are_adjusted_together():
    """The satellite's shift is seen in full: the frame cameras hold the ground."""
    exact = [*flight_of_frames(1, 4), replace(affine_sensors()[1], centre=(3000.0, 2000.0))]
    flawed = [*flawed_frames(exact[:4], sigma_m=0.2, sigma_deg=0.01), ShiftedModel(exact[4], 3.0, -4.0)]
    ground = frame_ground(500) * [0.5, 0.3, 1.0]
    found, xyz = oriented(exact, flawed, ground, FRAME_SIZE, control=control_of(exact, ground[:10], FRAME_SIZE))
    assert np.nanmax(image_errors(found, exact, xyz)) < RECOVERED_PX


def test_no_ties_leave_the_cameras_as_they_are():
    flawed, seen, _ = shifted_block(3)
    nothing = seen.kept(np.zeros(len(seen), bool))
    found = adjust_bundle(views_of(flawed, AFFINE_SIZE), nothing, np.empty((0, 3)), OPTIONS, GroundControl.none())
    assert all(a is b for a, b in zip(found.sensors, flawed, strict=True))
    assert np.isnan(found.solution.sigma0_px)


def test_control_alone_orients_an_image():
    exact = affine_sensors()
    flawed = [ShiftedModel(sensor, 2.0, -1.0) for sensor in exact]
    control = control_of(exact, random_ground(6), AFFINE_SIZE)
    nothing = control.observations.kept(np.zeros(len(control.observations), bool))
    found = adjust_bundle(views_of(flawed, AFFINE_SIZE), nothing, np.empty((0, 3)), OPTIONS, control)
    xy = project_points(found.sensors, control.observations, control.xyz)
    assert np.abs(xy - control.observations.xy).max() < 0.02
