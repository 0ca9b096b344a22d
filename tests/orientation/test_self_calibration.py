"""Self-calibration of frame cameras: planted errors are recovered, and standard deviations are honest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pyproj import CRS

from bundle_scenes import first_points, flight_of_frames, seen_by, views_of
from calibration_scenes import (
    DRONE_SIZE,
    block_ground,
    calibrated,
    crossing_block,
    flat_block,
    flawed_poses,
    options_with,
)
from zlocus.core.errors import ConfigError
from zlocus.core.options import BundleAdjustmentOptions, OrientationOptions
from zlocus.core.scene import Scene
from zlocus.orientation import bundle_adjustment, normal_equations, orientation
from zlocus.orientation.bundle_adjustment import adjust_bundle
from zlocus.orientation.self_calibration import calibration_groups, check_self_calibration, interior_change_px
from zlocus.orientation.tie_refinement import RefinedTies
from zlocus.orientation.ties import Ties
from zlocus.orientation.triangulate import Observations
from zlocus.sensors.distortion import BrownDistortion, FisheyeDistortion

SIGMAS = 3.0
# Root mean square of errors over their standard deviations, of 24 parameters: 1 with a standard deviation of 0.15.
HONEST = (0.7, 1.4)
SEEDS = range(4)
CALIBRATED = ("focal", "principal_point", "k1", "k2", "readout")


@pytest.fixture(autouse=True)
def one_round(monkeypatch):
    """These ties have no outliers, for which the adjustment is repeated."""
    monkeypatch.setattr(bundle_adjustment, "ROUNDS", 1)


def planted(seed):
    """Errors by name of the parameter, of random signs, all above the noise."""
    size = {
        "focal_px": 15.0, "principal_column_px": 6.0, "principal_row_px": 5.0, "k1": 3e-3, "k2": 4e-3, "readout_ms": 8.0
    }  # fmt: skip
    signs = np.random.default_rng(1000 + seed).choice([-1.0, 1.0], len(size))
    return {name: sign * value for sign, (name, value) in zip(signs, size.items(), strict=True)}


def flawed(cameras, errors):
    """The cameras without what has to be added."""
    return [
        replace(
            camera,
            focal=camera.focal - errors["focal_px"],
            principal_point=(
                camera.principal_point[0] - errors["principal_column_px"],
                camera.principal_point[1] - errors["principal_row_px"],
            ),
            distortion=replace(
                camera.distortion, k1=camera.distortion.k1 - errors["k1"], k2=camera.distortion.k2 - errors["k2"]
            ),
            rolling_shutter=replace(
                camera.rolling_shutter, readout_s=camera.rolling_shutter.readout_s - errors["readout_ms"] / 1000.0
            ),
        )
        for camera in cameras
    ]


def normalised_errors(seed):
    """Errors of all parameters of a block over their standard deviations, NaN where a parameter is held."""
    exact, errors = crossing_block(), planted(seed)
    delivered = flawed_poses(flawed(exact, errors), seed)
    found = calibrated(exact, delivered, block_ground(150, 8.0, seed), options_with(*CALIBRATED), seed=seed)
    assert [each.name for each in found.calibration] == list(errors)
    return [(each.value - errors[each.name]) / each.sigma for each in found.calibration]


def test_planted_parameters_are_recovered_and_standard_deviations_are_honest(monkeypatch):
    """Without the errors that all ties of an image may have in common, because these ties have none."""
    monkeypatch.setattr(normal_equations, "COMMON_PX", 0.0)
    errors = np.array([normalised_errors(seed) for seed in SEEDS])
    assert np.abs(errors).max() < SIGMAS
    assert HONEST[0] < np.sqrt((errors**2).mean()) < HONEST[1]


def test_planted_parameters_are_recovered_with_the_caution_for_common_errors():
    assert np.abs(normalised_errors(5)).max() < SIGMAS


def test_the_corrected_cameras_share_what_was_found():
    exact, errors = crossing_block(), planted(0)
    found = calibrated(exact, flawed(exact, errors), block_ground(120, 8.0), options_with(*CALIBRATED), noise_px=0.0)
    assert len({(s.focal, s.principal_point, s.distortion, s.rolling_shutter.readout_s) for s in found.sensors}) == 1
    first = found.sensors[0]
    assert first.focal == pytest.approx(3000.0, abs=0.2)
    assert first.distortion.k1 == pytest.approx(-0.10, abs=1e-4)
    assert first.rolling_shutter.readout_s == pytest.approx(0.030, abs=1e-4)
    assert [s.rolling_shutter.velocity for s in found.sensors] == [s.rolling_shutter.velocity for s in exact]


@pytest.mark.parametrize("tilts_deg", [0.0, 1.0, 3.0])
def test_over_flat_ground_nadir_images_hold_the_focal_length_and_say_why(tilts_deg):
    exact = flat_block(tilts_deg)
    delivered = flawed_poses([replace(camera, focal=camera.focal + 15.0) for camera in exact], 1)
    found = calibrated(exact, delivered, block_ground(150), options_with("focal"))
    (focal,) = found.calibration
    assert (focal.is_held, focal.value) == (True, 0.0)
    assert {sensor.focal for sensor in found.sensors} == {3015.0}
    (held,) = found.solution.held_parameters
    sentence = held.sentence([f"photo{i}" for i in range(len(exact))])
    assert sentence.startswith("The focal length of 12 images (photo0 to photo11) is held: ")
    assert "do not tell it from the flying height above the ground (correlation 0." in sentence or tilts_deg == 0.0
    assert abs(held.correlation) > 0.8


def test_oblique_images_release_the_focal_length():
    exact = crossing_block()
    delivered = [replace(camera, focal=camera.focal + 15.0) for camera in exact]
    found = calibrated(exact, delivered, block_ground(120), options_with("focal"))
    assert found.solution.held_parameters == ()
    assert [sensor.focal for sensor in found.sensors] == pytest.approx([3000.0] * len(exact), abs=1.5)


def test_a_readout_time_that_is_hardly_better_known_afterwards_is_held():
    """Read out in parallel strips, an image is stretched along the flight, as by a wrong scale of the positions."""
    exact = flat_block(0.0)
    found = calibrated(exact, exact, block_ground(150), options_with("readout", sigma_readout_ms=1.0))
    (held,) = found.solution.held_parameters
    assert held.name == "readout_ms"
    sentence = held.sentence(["a"] * 12)
    assert sentence.startswith("The read-out time of 12 images (a to a) is held: the tie points")
    assert "standard deviation. It correlates most with the " in sentence


def test_parameters_without_errors_stay_as_delivered():
    """But for one in ten that noise makes larger than its standard deviation."""
    exact = crossing_block()
    found = calibrated(exact, exact, block_ground(120, 8.0), options_with("all"))
    moved = [each for each in found.calibration if not each.is_held]
    assert len(moved) <= 1
    assert all(abs(each.value) < SIGMAS * each.sigma for each in moved)
    assert found.solution.held_parameters == ()


def test_images_share_the_parameters_of_their_camera():
    cameras = flight_of_frames(1, 4)
    other = replace(cameras[3], focal=5000.0)
    options = OrientationOptions(bundle_adjustment=BundleAdjustmentOptions(self_calibration=("all",)))
    groups = calibration_groups(views_of([*cameras[:3], other], (6000, 4000)), options)
    assert {group.views for group in groups} == {(0, 1, 2), (3,)}
    assert [name for group in groups if group.views == (3,) for name in group.names] == [
        "focal_px", "principal_column_px", "principal_row_px", "k1", "k2", "k3", "p1", "p2",
    ]  # fmt: skip
    assert all(group.is_calibration for group in groups)


def test_standard_deviations_of_coefficients_are_movements_of_the_corner():
    options = options_with("k1", "k2", "k3", sigma_distortion_px=4.0)
    camera = replace(crossing_block()[0], distortion=None, rolling_shutter=None)
    corner = np.array([[0.0, 0.0]])
    xyz = camera.ground_from_image(corner, np.zeros(1))
    for group in calibration_groups(views_of([camera], DRONE_SIZE), options):
        moved = group.correct(camera, group.sigma).image_from_ground(xyz) - corner
        assert np.hypot(*moved[0]) == pytest.approx(4.0, rel=1e-6)


def test_a_fisheye_lens_has_its_own_coefficients():
    camera = replace(flight_of_frames(1, 2)[0], distortion=FisheyeDistortion(0.01))
    views = views_of([camera, camera], (6000, 4000))
    groups = calibration_groups(views, options_with("all"))
    assert [name for group in groups for name in group.names if name[0] in "kp"][-3:] == ["k1", "k2", "k3"]
    k1 = next(group for group in groups if group.names == ("k1",))
    assert k1.correct(camera, np.array([0.02])).distortion == FisheyeDistortion(0.03)
    check_self_calibration(views, options_with("all"))
    with pytest.raises(ConfigError, match="lens of view0 has a distortion without p1 and p2"):
        check_self_calibration(views, options_with("p1", "p2"))


def test_a_readout_time_needs_a_rolling_shutter():
    views = views_of(flight_of_frames(1, 2), (6000, 4000))
    assert calibration_groups(views, options_with("readout")) == ()
    check_self_calibration(views, options_with("all"))
    with pytest.raises(ConfigError, match="No camera of the scene has a rolling_shutter"):
        check_self_calibration(views, options_with("focal", "readout"))


def test_an_ideal_lens_gets_a_distortion():
    exact = crossing_block()
    delivered = [replace(camera, distortion=None) for camera in exact]
    seen, xyz = seen_by(exact, block_ground(120, 8.0), DRONE_SIZE)
    options = options_with("k1", "k2", "p1", "p2", sigma_distortion_px=300.0)
    found = adjust_bundle(views_of(delivered, DRONE_SIZE), seen, first_points(delivered, seen, xyz), options)
    lens = found.sensors[0].distortion
    assert isinstance(lens, BrownDistortion)
    assert (lens.k1, lens.k2) == (pytest.approx(-0.10, abs=2e-3), pytest.approx(0.03, abs=4e-3))


def test_a_standard_deviation_of_what_is_not_calibrated_is_refused():
    with pytest.raises(ConfigError, match='Add "focal" to self_calibration'):
        BundleAdjustmentOptions(sigma_focal_px=10.0)
    with pytest.raises(ConfigError, match="self_calibration = 'focus' is not one of all, focal"):
        BundleAdjustmentOptions(self_calibration=("focus",))


# Distance by which a wrongly stated lens may move features so that they still lie near enough to their epipolar curves.
NEAR_ENOUGH_PX = 12.0


class Searches:
    """Stands for the search for ties: those are found whose image points the lens of the search moves by little."""

    def __init__(self, exact, delivered):
        self.exact, self.delivered, self.scenes = exact, delivered, []
        self.seen, xyz = seen_by(exact, block_ground(600, 8.0), DRONE_SIZE, 0.1)
        self.z = xyz[:, 2]

    def __call__(self, scene, options, z_range_hint, progress, threads):
        self.scenes.append(scene)
        off = np.empty(len(self.seen))
        for number, (view, exact) in enumerate(zip(scene.views, self.exact, strict=True)):
            mine = self.seen.view == number
            at = exact.ray_from_image(self.seen.xy[mine])
            lens = replace(exact, distortion=view.sensor.distortion, rolling_shutter=None)
            off[mine] = np.hypot(*(lens.image_from_ray(at) - self.seen.xy[mine]).T)
        found = self.seen.kept(off < NEAR_ENOUGH_PX)
        found = found.kept(np.bincount(found.point, minlength=len(self.z))[found.point] >= 2)
        points, number = np.unique(found.point, return_inverse=True)
        found = Observations(found.view, number, found.xy)
        return RefinedTies(Ties(found, self.z[points], (), (-1.0, 9.0)), found)


def orientation_after(searches, monkeypatch, options, **request):
    """The orientation of the delivered cameras by the ties that `searches` finds."""
    monkeypatch.setattr(orientation, "_measure_ties", searches)
    scene = Scene(tuple(views_of(searches.delivered, DRONE_SIZE)), CRS.from_epsg(32632), heights=(-1.0, 9.0))
    return orientation.orient(scene, replace(options, model="joint"), orientation.OrientationRequest(**request))


@pytest.fixture
def wrongly_stated():
    """Cameras with a lens that moves the corners by 140 px, and the same without it and with errors of their poses."""
    exact = [replace(camera, distortion=BrownDistortion(-0.10, 0.03)) for camera in crossing_block()]
    return Searches(exact, flawed_poses([replace(camera, distortion=None) for camera in exact], 2))


LENS_OPTIONS = options_with("k1", "k2", sigma_distortion_px=150.0)


def test_ties_are_searched_again_with_the_lens_that_was_found(wrongly_stated, monkeypatch):
    """From their delivered poses, until the lens stays as it is; then ties are found in whole images."""
    found = orientation_after(wrongly_stated, monkeypatch, LENS_OPTIONS)
    first, *again = wrongly_stated.scenes
    assert [view.sensor for view in first.views] == wrongly_stated.delivered
    assert 1 <= len(again) < orientation.MAX_SEARCHES
    last = [view.sensor for view in again[-1].views]
    assert len({sensor.distortion for sensor in last}) == 1
    assert last[0].distortion.k1 == pytest.approx(-0.10, abs=0.01)
    for sensor, delivered in zip(last, wrongly_stated.delivered, strict=True):
        assert replace(sensor, distortion=None) == delivered
    farthest = [np.hypot(*(ties.xy - 2000.0).T).max() for ties in (
        wrongly_stated(first, None, None, None, 1).observations, found.refined_ties.observations,
    )]  # fmt: skip
    assert farthest[0] < 0.8 * farthest[1]
    (k1, k2) = found.bundle_adjustment.calibration
    assert abs(k1.value + 0.10) < SIGMAS * k1.sigma
    assert abs(k2.value - 0.03) < SIGMAS * k2.sigma


def test_known_ties_of_a_search_with_the_lens_make_the_same_orientation(wrongly_stated, monkeypatch):
    found = orientation_after(wrongly_stated, monkeypatch, LENS_OPTIONS)
    n_searches = len(wrongly_stated.scenes)
    again = orientation_after(wrongly_stated, monkeypatch, LENS_OPTIONS, refined_ties=found.refined_ties)
    assert len(wrongly_stated.scenes) == n_searches
    assert again.bundle_adjustment.sensors == found.bundle_adjustment.sensors


@pytest.mark.parametrize("is_calibrated", [True, False])
def test_ties_are_searched_once_where_no_lens_was_found_to_be_wrong(wrongly_stated, monkeypatch, is_calibrated):
    """With the right lens, and with a wrong one that is not to be corrected."""
    if is_calibrated:
        wrongly_stated.delivered = flawed_poses(wrongly_stated.exact, 2)
    orientation_after(wrongly_stated, monkeypatch, LENS_OPTIONS if is_calibrated else options_with())
    assert len(wrongly_stated.scenes) == 1


def test_the_change_of_a_camera_is_that_beyond_the_motion_of_its_image():
    camera = replace(flat_block(0.0)[0], distortion=None, rolling_shutter=None)
    moved, longer = camera.moved(40.0, -30.0), replace(camera, focal=camera.focal * 1.01)
    one, *others = (views_of([each], DRONE_SIZE) for each in (camera, moved, longer))
    # A longer focal length moves points away from the middle of the image, those in the corners farthest.
    for other, expected in zip(others, (0.0, 0.01 * np.hypot(1999.5, 1499.5)), strict=True):
        assert interior_change_px(one, other, 0.0) == pytest.approx(expected, abs=1e-6)
