"""Features, guided matches and tracks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from pyproj import CRS
from scipy.spatial import cKDTree

from orientation_scenes import AffineSensor, ArrayImage, hill, hill_scene, image_of, texture
from rpc_fixtures import satellite_rpc
from zlocus.core.errors import GeometryError
from zlocus.core.options import OrientationOptions
from zlocus.orientation import sift as features_module
from zlocus.orientation.epipolar import EpipolarCurves, Sightlines
from zlocus.orientation.kernels.descriptors import DESCRIPTOR_LENGTH_UNITS
from zlocus.orientation.sift import Features, detect, part_grid, reduction
from zlocus.orientation.ties import PairMatches, find_ties, join_tracks, match_along_curves, widest_range
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.rpc import RpcModel

SAME_RAY_PX = 1e-3
OPTIONS = OrientationOptions(features_per_mpx=20000)
FULL_DETAIL = OrientationOptions(features_per_mpx=100000, full_detail_mpx=100.0)
REDUCED = OrientationOptions(features_per_mpx=100000, full_detail_mpx=0.05)


def everywhere(shape):
    return np.ones(part_grid(shape), bool)


def blobs(size, sigma_px, spacing, seed=0):
    """Bright spots at known places: the image and their centres (n, 2) px."""
    rng = np.random.default_rng(seed)
    grid = np.arange(spacing, size - spacing + 1, spacing)
    centres = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2) + rng.uniform(-0.5, 0.5, (len(grid) ** 2, 2))
    row, col = np.mgrid[:size, :size]
    image = np.full((size, size), 500.0)
    for x, y in centres:
        image += 900.0 * np.exp(-((col - x) ** 2 + (row - y) ** 2) / (2 * sigma_px**2))
    return image, centres


@pytest.mark.parametrize(("options", "sigma_px"), [(FULL_DETAIL, 2.0), (REDUCED, 4.0)])
def test_positions_have_no_offset(options, sigma_px):
    """(0, 0) is the centre of the first pixel, whether or not the image was reduced."""
    image, centres = blobs(240, sigma_px, 40)
    found = detect(image_of(image), everywhere(image.shape), options)
    offset = found.xy[:, None] - centres
    nearest = np.abs(offset).max(axis=2).argmin(axis=1)
    offset = offset[np.arange(len(found)), nearest]
    offset = offset[np.abs(offset).max(axis=1) < 1.0]
    assert len(offset) >= len(centres)
    assert np.abs(offset.mean(axis=0)).max() < 0.03


@pytest.mark.parametrize("gain", [0.01, 40.0])
def test_features_do_not_depend_on_gain_and_offset(gain):
    image = texture()[:300, :300]
    one = detect(image_of(image), everywhere(image.shape), OPTIONS)
    two = detect(image_of(image * gain + 7.0), everywhere(image.shape), OPTIONS)
    assert len(one) > 300
    assert abs(len(two) - len(one)) < 0.02 * len(one)


def test_work_grows_with_the_square_root_of_the_pixels():
    options = OrientationOptions()
    assert reduction((500, 500), options) == 1.0
    side = math.sqrt(options.full_detail_mpx * 1e6) + 1.0
    assert reduction((side, side), options) == pytest.approx(2.0, abs=0.01)
    looked_at = [n * n / reduction((n, n), options) ** 2 for n in (1000, 4000, 16000)]
    assert np.diff(np.log2(looked_at)) == pytest.approx(2.0, abs=0.05)


def test_the_edge_of_nodata_gives_no_features():
    image = texture()[:300, :300] * 100.0 + 5000.0
    valid = np.ones(image.shape, bool)
    valid[:, :120] = False
    valid[140:160, 200:220] = False
    found = detect(image_of(image, valid), everywhere(image.shape), FULL_DETAIL)
    free = detect(image_of(image), everywhere(image.shape), FULL_DETAIL)
    cell = found.xy.round().astype(int)
    assert valid[cell[:, 1], cell[:, 0]].all()
    assert found.xy[:, 0].min() > 124
    assert 0.2 * len(free) < len(found) < 0.6 * len(free)


def test_constant_and_all_nodata_images_have_no_features():
    flat = np.full((200, 200), 7.0)
    assert len(detect(image_of(flat), everywhere(flat.shape), OPTIONS)) == 0
    assert len(detect(image_of(flat, np.zeros(flat.shape, bool)), everywhere(flat.shape), OPTIONS)) == 0


@dataclass(frozen=True)
class Watched(ArrayImage):
    """Remembers the largest window asked for."""

    sizes: list

    def read(self, row, col, rows, cols):
        self.sizes.append(rows * cols)
        return super().read(row, col, rows, cols)


def test_large_images_are_read_part_by_part_and_features_spread(monkeypatch):
    monkeypatch.setattr(features_module, "PART_PX", 200)
    image = np.tile(texture()[:350, :350], (2, 2))
    image[:, :350] *= 4.0  # the stronger half must not take all the features
    watched = Watched(image.astype(np.float32), np.ones(image.shape, bool), [])
    found = detect(watched, everywhere(image.shape), replace(OPTIONS, features_per_image=1600))
    assert max(watched.sizes) <= (234 + 2 * math.ceil(features_module.HALO_PX * reduction(image.shape, OPTIONS))) ** 2
    assert 1000 < len(found) <= 1700
    left = (found.xy[:, 0] < 350).mean()
    assert 0.3 < left < 0.7
    wanted = np.zeros(part_grid(image.shape), bool)
    wanted[0, 2] = True
    some = detect(watched, wanted, OPTIONS)
    assert 349.5 <= some.xy[:, 0].min() < some.xy[:, 0].max() < 524.5
    assert some.xy[:, 1].max() < 174.5


def test_cutting_into_parts_does_not_move_features(monkeypatch):
    image = texture()[:300, :300]
    whole = detect(image_of(image), everywhere(image.shape), FULL_DETAIL)
    monkeypatch.setattr(features_module, "PART_PX", 150)
    cut = detect(image_of(image), everywhere(image.shape), FULL_DETAIL)
    nearest = cKDTree(cut.xy).query(whole.xy)[0]
    assert (nearest < 0.1).mean() > 0.9
    assert len(cut) == pytest.approx(len(whole), rel=0.1)


def test_ties_lie_on_the_ground_despite_wrong_pointing():
    scene = hill_scene([(0.0, 0.0), (3.0, -8.0), (-5.0, 4.0)])
    ties = find_ties(scene, OPTIONS)
    assert [p.views for p in ties.pairs] == [(0, 1), (0, 2), (1, 2)]
    assert all(len(p) > 100 for p in ties.pairs)
    exact = [view.sensor.base_sensor for view in scene.views]
    error = np.full(len(ties.observations), np.nan)
    for i, sensor in enumerate(exact):
        rows = np.flatnonzero(ties.observations.view == i)
        xyz = sensor.ground_from_image(ties.observations.xy[rows], np.full(len(rows), 110.0))
        for _ in range(20):
            xyz = sensor.ground_from_image(ties.observations.xy[rows], hill(xyz[:, 0], xyz[:, 1]))
        error[rows] = xyz[:, 0]
    spread = [np.ptp(error[ties.observations.point == p]) for p in range(0, len(ties.z), 5)]
    assert np.median(spread) < 0.25
    assert np.mean(np.array(spread) < 1.5) > 0.95


def test_a_shift_beyond_the_limit_is_not_found():
    scene = hill_scene([(0.0, 0.0), (0.0, 25.0)])
    assert find_ties(scene, OPTIONS).pairs
    assert not find_ties(scene, replace(OPTIONS, max_pointing_px=10.0)).pairs


def test_ties_survive_heights_that_a_pointing_error_moves_away():
    """15 px along the loci are 25 m of height, beyond the 20 m that were asked for."""
    scene = hill_scene([(0.0, 0.0), (15.0, 0.0)], looks=((0.0, 0.0), (0.3, 0.0)), turn_deg=(0.0, 0.0))
    ties = find_ties(scene, OPTIONS, (100.0, 120.0))
    assert len(ties.z) > 100
    assert not ((ties.z > 95.0) & (ties.z < 121.0)).any()


def test_images_of_different_ground_are_not_compared():
    scene = hill_scene([(0.0, 0.0), (0.0, 0.0)])
    far = replace(scene.views[1], sensor=ShiftedModel(scene.views[1].sensor, 9000.0, 0.0))
    stages = []
    ties = find_ties(replace(scene, views=(scene.views[0], far)), OPTIONS, progress=lambda *done: stages.append(done))
    assert len(ties.observations) == 0
    assert len(ties.z) == 0
    assert stages[-1] == ("matches", 1.0)


def test_the_heights_looked_at_come_from_the_hint_or_the_models():
    scene = hill_scene([(0.0, 0.0), (0.0, 0.0)], size=64)
    assert widest_range(scene.views) == (0.0, 300.0)
    assert find_ties(scene, OPTIONS, (90.0, 130.0)).z_range == (90.0, 130.0)
    assert find_ties(replace(scene, heights=(80.0, 140.0)), OPTIONS).z_range == (80.0, 140.0)
    anywhere = tuple(replace(v, sensor=AffineSensor(0.0, 0.0, bounds=None)) for v in scene.views)
    with pytest.raises(GeometryError, match="--heights"):
        find_ties(replace(scene, views=anywhere), OPTIONS)


def unit(*numbers):
    vectors = np.zeros((len(numbers), 128), np.int16)
    for row, number in enumerate(numbers):
        vectors[row, number] = DESCRIPTOR_LENGTH_UNITS
    return vectors


def test_matches_are_mutual_unambiguous_and_near_their_locus():
    """Four points on parallel loci; each rival breaks one rule."""
    low = np.array([[0.0, 0.0], [0.0, 50.0], [0.0, 100.0], [0.0, 150.0]])
    loci = EpipolarCurves(low, low + np.array([80.0, 0.0]), 0.0, 100.0)
    in_a = Features(low, unit(0, 1, 2, 3))
    xy_b = np.array([[40.0, 1.0], [40.0, 60.0], [30.0, 100.0], [60.0, 100.0], [40.0, 150.0], [40.8, 150.0]])
    in_b = Features(xy_b, unit(0, 1, 2, 2, 3, 3))
    first, second = match_along_curves(loci, in_a, in_b, 5.0, 0.8)
    # 1 lies 10 px off its locus; 2 has an equal rival elsewhere; 3's rival is at the same place, so no rival
    assert first.tolist() == [0, 3]
    assert second.tolist() == [0, 4]
    wider, _ = match_along_curves(loci, in_a, in_b, 12.0, 0.8)
    assert wider.tolist() == [0, 1, 3]
    twins = Features(low[[0, 0]] + np.array([[0.0, 0.0], [0.0, 4.0]]), unit(0, 0))
    twins.descriptors[0, 9] = DESCRIPTOR_LENGTH_UNITS // 10
    twins.descriptors[0, 0] = DESCRIPTOR_LENGTH_UNITS * np.sqrt(0.99)
    pair = EpipolarCurves(twins.xy, twins.xy + np.array([80.0, 0.0]), 0.0, 100.0)
    first, _ = match_along_curves(pair, twins, in_b.only(np.array([0])), 5.0, 0.8)
    assert first.tolist() == [1]  # the one whose descriptor is nearer takes the point


def pair_of(views, first, second, z):
    return PairMatches(views, np.array(first), np.array(second), np.array(z, float), len(first), np.zeros(2))


def test_matches_of_all_pairs_join_into_points():
    views = [Features(np.arange(10.0).reshape(5, 2) * 10.0, np.zeros((5, 128), np.int16)) for _ in range(3)]
    pairs = (
        pair_of((0, 1), [0, 1], [3, 1], [10.0, 20.0]),
        pair_of((1, 2), [3, 2], [4, 2], [14.0, 30.0]),
    )
    ties = join_tracks(views, pairs, (0.0, 100.0))
    assert sorted(zip(ties.observations.view.tolist(), ties.observations.point.tolist(), strict=True)) == [
        (0, 0), (0, 1), (1, 0), (1, 1), (1, 2), (2, 0), (2, 2),
    ]  # fmt: skip
    assert ties.z.tolist() == [12.0, 20.0, 30.0]
    assert ties.observations.xy[ties.observations.point == 0].tolist() == [[0.0, 10.0], [60.0, 70.0], [80.0, 90.0]]


def test_a_point_seen_twice_by_one_image_is_dropped():
    views = [Features(np.arange(10.0).reshape(5, 2) * 10.0, np.zeros((5, 128), np.int16)) for _ in range(3)]
    pairs = (
        pair_of((0, 1), [0, 1], [0, 1], [10.0, 20.0]),
        pair_of((0, 2), [2], [2], [10.0]),
        pair_of((1, 2), [0], [2], [10.0]),
    )
    ties = join_tracks(views, pairs, (0.0, 100.0))
    assert ties.z.tolist() == [20.0]
    assert ties.observations.view.tolist() == [0, 1]


def test_orientations_of_one_place_are_one_feature():
    xy = np.array([[5.0, 5.0], [5.0, 5.0], [9.0, 9.0]])
    views = [Features(xy, np.zeros((3, 128), np.int16)) for _ in range(2)]
    ties = join_tracks(views, (pair_of((0, 1), [0, 1], [0, 1], [10.0, 10.0]),), (0.0, 100.0))
    assert len(ties.z) == 1
    assert len(ties.observations) == 2


def test_sightlines_are_the_rays_of_the_sensor():
    """Over the whole height box of an RPC, and beyond it, where the sensor itself is asked."""
    sensor = RpcModel(satellite_rpc(), CRS.from_epsg(32631))
    rng = np.random.default_rng(3)
    xy = rng.uniform(15000, 25000, (200, 2))
    lines, z = Sightlines.of(sensor, xy, (-50.0, 950.0)), rng.uniform(-200.0, 1100.0, 200)
    back = sensor.image_from_ground(lines.at(z))
    assert np.abs(back - xy).max() < SAME_RAY_PX
    far = np.full(200, 2500.0)
    np.testing.assert_array_equal(lines.at(far), sensor.ground_from_image(xy, far))
    few = np.array([3, 77])
    np.testing.assert_array_equal(lines.only(few).at(z[few]), lines.at(z)[few])


def test_a_ray_that_one_end_of_the_heights_does_not_meet_is_the_sensors():
    class Low:
        """Knows no ground above 100 m."""

        def ground_from_image(self, xy, z):
            return np.where(np.asarray(z)[:, None] > 100.0, np.nan, np.column_stack([xy, z]))

    xy = np.array([[3.0, 4.0], [5.0, 6.0]])
    ground = Sightlines.of(Low(), xy, (0.0, 300.0)).at(np.array([50.0, 200.0]))
    np.testing.assert_array_equal(ground[0], [3.0, 4.0, 50.0])
    assert np.isnan(ground[1]).all()
