"""Standard deviations of heights: predictors, the additive model, and whether they hold on a scene of known truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zlocus.matching import precision
from zlocus.matching.kernels.precision import add_curve
from zlocus.matching.match_curve import predicted_sigma
from zlocus.matching.precision import (
    MIN_ROUGHNESS_STEPS,
    distance_from_agreement,
    is_split,
    sigma_steps,
    spread_around,
    uncertainty_predictors,
)
from zlocus.matching.precision_calibration import PAIR, SPLIT
from zlocus.matching.semiglobal import SemiGlobalHeights
from zlocus.matching.subpixel import RefinedHeights, peak_variance

SHAPE, LOGARITHM = (24, 30), 1e-5
MAX_DISTANCE = 32.0
INNER = (slice(6, -6), slice(6, -6))


def refined(**changed) -> RefinedHeights:
    """Level heights of good cells."""
    values = {
        "height": 20.0,
        "ncc": 0.9,
        "is_refined": True,
        "smooth": 20.0,
        "curvature": 0.4,
        "group_distance": 0.1,
        "is_fixed": False,
    }
    arrays = {k: np.full(SHAPE, v, bool if k.startswith("is_") else np.float32) for k, v in values.items()}
    arrays |= changed
    return RefinedHeights(**arrays, variance=peak_variance(arrays["ncc"], arrays["curvature"], np.full(SHAPE, 4), 49))


def semi_global(height) -> SemiGlobalHeights:
    best = np.rint(height).astype(np.int32)
    return SemiGlobalHeights(best, best, np.full(SHAPE, 500, np.uint16), np.asarray(height, np.float32))


def predictors(found: RefinedHeights, n_seeing=4, vertex=None, texture=0.3):
    heights = semi_global(found.height if vertex is None else vertex)
    texture_of_cells = np.full(SHAPE, texture, np.float32)
    return uncertainty_predictors(heights, found, np.full(SHAPE, n_seeing), texture_of_cells, MAX_DISTANCE)


def sigma(found: RefinedHeights, **kwargs) -> np.ndarray:
    return sigma_steps(predictors(found, **kwargs), found)


@given(
    st.lists(st.floats(-5, 5), min_size=2, max_size=9),
    st.floats(-3, 3), st.floats(0.1, 2), st.lists(st.floats(-50, 50), min_size=1, max_size=30),
)  # fmt: skip
def test_curves_are_piecewise_linear(curve, first, spacing, values):
    knots = first + spacing * np.arange(len(curve))
    values, curve = np.array(values, np.float32), np.array(curve, np.float32)
    out = np.full(len(values), 0.5, np.float32)
    add_curve(values, np.float32(first), np.float32(spacing), curve, out)
    steepest = np.abs(np.diff(curve)).max() / spacing
    tolerance = 1e-4 + 1e-5 * steepest * 60
    np.testing.assert_allclose(out, 0.5 + np.interp(values, knots, curve), rtol=0, atol=tolerance)


def test_noise_is_the_predicted_sigma():
    """Of a curve with that peak and curvature, see `zlocus.matching.match_curve`."""
    curve = 0.9 - 0.2 * (np.arange(-4, 5.0) / 2) ** 2
    of_curve = predicted_sigma(curve[None, ::2], np.full((1, 5), 4), 49)
    found = predictors(refined())["noise"]
    np.testing.assert_allclose(np.exp(found), of_curve[0], rtol=LOGARITHM)


def test_predictors_of_a_step_stand_beside_it():
    height = np.full(SHAPE, 20.0, np.float32)
    height[:, 15:] = 40.0
    found = predictors(refined(height=height, smooth=height))
    np.testing.assert_allclose(found["range_5"][:, [12, 17]], np.log(0.1), rtol=0, atol=LOGARITHM)
    np.testing.assert_allclose(found["range_5"][:, [13, 16]], np.log(20.1), rtol=0, atol=LOGARITHM)
    np.testing.assert_allclose(found["range_9"][:, [11, 18]], np.log(20.1), rtol=0, atol=LOGARITHM)
    np.testing.assert_allclose(found["spread"][:, 20], np.log(MIN_ROUGHNESS_STEPS), rtol=0, atol=0.2)
    assert (found["spread"][:, 14] > np.log(5)).all()
    rough = predictors(refined(height=height))["roughness"]
    np.testing.assert_allclose(rough[:, 20], np.log(20 + MIN_ROUGHNESS_STEPS), rtol=0, atol=LOGARITHM)
    moved = predictors(refined(), vertex=np.full(SHAPE, 20.7))["refinement"]
    np.testing.assert_allclose(moved, np.log(0.75), rtol=0, atol=LOGARITHM)


def test_groups_of_images_speak_for_the_cells_around():
    group_distance = np.full(SHAPE, np.nan, np.float32)
    group_distance[12, 15] = 0.6
    found = predictors(refined(group_distance=group_distance))
    near = np.zeros(SHAPE, bool)
    near[9:16, 12:19] = True
    np.testing.assert_array_equal(is_split(found), near)
    np.testing.assert_allclose(found["group_distance"][near], np.log(0.6), rtol=0, atol=1e-3)


def test_every_predictor_has_a_curve_and_every_cell_a_sigma():
    """Whatever is unknown: no round of refinement, no image, no peak."""
    nothing = refined(
        group_distance=np.full(SHAPE, np.nan, np.float32), curvature=np.zeros(SHAPE, np.float32),
        ncc=np.full(SHAPE, -1, np.float32), is_refined=np.zeros(SHAPE, bool),
    )  # fmt: skip
    assert set(predictors(nothing)) == set(PAIR[3]) == set(SPLIT[3])
    for n_seeing in (0, 1, 2, 200):
        found = sigma(nothing, n_seeing=n_seeing)
        assert found.dtype == np.float32
        assert np.isfinite(found).all()
        assert (found > 0).all()


@pytest.mark.parametrize("is_known", [(12, 15), (slice(None), slice(None)), (slice(0), slice(0))])
def test_each_cell_has_the_sigma_of_its_model(is_known):
    """Some cells of either model, all of one, all of the other; half of them refined."""
    rng, group_distance = np.random.default_rng(0), np.full(SHAPE, np.nan, np.float32)
    group_distance[is_known] = 0.3
    height = rng.normal(20, 1, SHAPE).astype(np.float32)
    found = refined(group_distance=group_distance, height=height, is_refined=rng.random(SHAPE) < 0.5)
    said, line_shift_steps = predictors(found), 0.2
    split, sigmas = is_split(said), sigma_steps(said, found, line_shift_steps)
    for model, cells in ((SPLIT, split), (PAIR, ~split)):
        constant, not_refined, of_lines, curves = model
        expected = constant + np.where(found.is_refined, 0.0, not_refined)
        for name, (first, spacing, curve) in curves.items():
            expected += np.interp(said[name], first + spacing * np.arange(len(curve)), curve)
        expected = np.log(np.hypot(np.exp(expected), of_lines * line_shift_steps))
        np.testing.assert_allclose(np.log(sigmas[cells]), expected[cells], rtol=0, atol=LOGARITHM)


def test_displaced_lines_are_an_error_of_their_own():
    found = refined()
    without, with_lines = (sigma_steps(predictors(found), found, steps) for steps in (0.0, 0.5))
    of_lines = SPLIT[2]
    assert of_lines > 0.1
    np.testing.assert_allclose(with_lines, np.hypot(without, of_lines * 0.5), rtol=LOGARITHM)


def test_a_place_without_texture_is_less_precise():
    found = refined()
    plain, textured = (sigma(found, texture=texture) for texture in (0.0, 0.3))
    assert (plain > 1.1 * textured).all()


def test_distance_is_that_from_the_nearest_agreement():
    ncc = np.full((40, 60), 0.9, np.float32)
    ncc[:, 20:] = 0.0
    found = distance_from_agreement(ncc, MAX_DISTANCE)
    assert (found[:, :20] == 0).all()
    # The mean over nine cells is below the limit from this column on.
    np.testing.assert_allclose(found[20, 20:], np.minimum(np.arange(1, 41), MAX_DISTANCE), atol=1e-5)
    assert (distance_from_agreement(np.zeros((8, 9), np.float32), MAX_DISTANCE) == MAX_DISTANCE).all()


def test_sigma_grows_with_the_distance_from_all_agreement():
    ncc = np.full(SHAPE, 0.9, np.float32)
    ncc[:, 5:] = 0.0
    found = sigma(refined(ncc=ncc))
    assert (found[:, 25] > 1.5 * found[:, 10]).all()


def test_texture_is_that_of_the_views_that_cover_a_cell(monkeypatch):
    stripes = np.broadcast_to(np.where(np.arange(SHAPE[1]) % 2, 1.0, -1.0).astype(np.float32), SHAPE)
    orthos = [np.ascontiguousarray(stripes), np.zeros(SHAPE, np.float32)]
    monkeypatch.setattr(precision, "ortho_image", lambda tile_views, height, view: orthos[view])
    is_covered = np.ones((2, *SHAPE), bool)
    is_covered[1, :, :10] = False
    is_covered[:, :5] = False
    found = precision.texture_around(None, np.zeros(SHAPE, np.float32), is_covered)
    of_stripes = np.sqrt(1.0 - 1.0 / 25.0)  # of 5 x 5 cells, two or three columns are bright
    np.testing.assert_allclose(found[8:-3, 3:10], of_stripes, atol=LOGARITHM)
    np.testing.assert_allclose(found[8:-3, 10:-3], of_stripes / 2, atol=LOGARITHM)
    assert (found[:5] == 0.0).all()


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        ({"ncc": 0.95}, {"ncc": 0.6}),
        ({"curvature": 0.8}, {"curvature": 0.1}),
        ({"group_distance": 0.05}, {"group_distance": 0.8}),
        ({"smooth": 20.05}, {"smooth": 21.5}),
    ],
)
def test_worse_predictors_give_a_larger_sigma(better, worse):
    """Each alone, others unchanged: predictors that go together share the effect between them."""
    small, large = (
        sigma(refined(**{k: np.full(SHAPE, v, np.float32) for k, v in one.items()}))[INNER] for one in (better, worse)
    )
    assert (large > 1.1 * small).all()


def test_spread_around_tells_noise_from_one_uncertain_cell():
    sigma = np.full((21, 23), 0.2, np.float32)
    sigma[4, 5] = 50.0
    sigma[12:, 12:] = 20.0
    spread = spread_around(sigma)
    assert spread[4, 5] < 0.5
    np.testing.assert_allclose(spread[15:, 15:], 20.0, rtol=1e-4)
    np.testing.assert_allclose(spread[:2, :2], 0.2, rtol=1e-4)
