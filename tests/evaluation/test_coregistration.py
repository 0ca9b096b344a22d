"""Co-registration by slope and aspect: planted shifts are found whatever lies on them, or it says why not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter

from evaluation_rasters import NORTH, WEST, grid, moved, rolling, write
from zlocus.core.errors import ConfigError, InputError
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.coregistration import CONVERGED_SHIFT_M, coregister
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.frame import Points
from zlocus.evaluation.heights import read_heights
from zlocus.evaluation.table import evaluation_table
from zlocus.evaluation.truth import truth_blocks

N = 240
# Heights are exact, and interpolated the same way on both sides.
EXACT_CONVERGED_SHIFT_M = 0.002
# Noise of 0.3 m on 200 x 200 blocks, slopes of 0.25 east and north: 0.3 / (0.25 * 200) = 6 mm, times four.
NOISY_CONVERGED_SHIFT_M = 0.024
# One cell in 20 that is too high spoils one height in 5 between four cells; their median moves by 0.29 of 0.17 m.
OUTLIERS_UP_CONVERGED_SHIFT_M = 0.06
# Between two grids, heights are interpolated over 0.8 m: ground of 15 m radius is cut off by less than this.
OTHER_GRID_CONVERGED_SHIFT_M = 0.01


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    return moved(tmp_path_factory.mktemp("reference") / "reference.tif", N, (0, 0, 0))


def found(dsm, reference, **options):
    shift = evaluate(dsm, Comparison(reference, coregister="nuth-kaab", **options)).shift
    return shift.east_m, shift.north_m, shift.up_m


@pytest.mark.parametrize("planted", [(0, 0, 0), (1.23, -0.68, 0.75), (-3.1, 0.4, -40), (0.2, 5.5, 3), (-6, -4, 0)])
def test_a_planted_shift_is_found(tmp_path, reference, planted):
    assert found(moved(tmp_path / "d.tif", N, planted), reference) == pytest.approx(
        planted, abs=EXACT_CONVERGED_SHIFT_M
    )


@settings(max_examples=15)
@given(east=st.floats(-5, 5), north=st.floats(-5, 5), up=st.floats(-100, 100))
def test_any_shift_within_five_metres_is_found(tmp_path_factory, reference, east, north, up):
    dsm = moved(tmp_path_factory.mktemp("dsm") / "d.tif", N, (east, north, up))
    assert found(dsm, reference) == pytest.approx((east, north, up), abs=EXACT_CONVERGED_SHIFT_M)


def test_it_is_found_through_noise(tmp_path, reference):
    rng = np.random.default_rng(1)
    dsm = moved(tmp_path / "d.tif", N, (2.1, -1.7, 5), change=lambda z: z + rng.normal(0, 0.3, z.shape))
    assert found(dsm, reference) == pytest.approx((2.1, -1.7, 5), abs=NOISY_CONVERGED_SHIFT_M)


def test_it_is_found_through_outliers_and_holes(tmp_path, reference):
    rng = np.random.default_rng(2)

    def spoiled(z):
        z = z + rng.normal(0, 0.3, z.shape)
        z[rng.random(z.shape) < 0.05] += 20.0
        z[60:120, 60:150] = np.nan
        z[rng.random(z.shape) < 0.02] = np.nan
        return z

    east, north, up = found(moved(tmp_path / "d.tif", N, (2.1, -1.7, 5), change=spoiled), reference)
    assert (east, north) == pytest.approx((2.1, -1.7), abs=NOISY_CONVERGED_SHIFT_M)
    assert up == pytest.approx(5, abs=OUTLIERS_UP_CONVERGED_SHIFT_M)


def test_what_stands_on_the_ground_does_not_pull(tmp_path, reference):
    # A wood of 6 m on the slopes to the north alone: a mean of each slope would shift the ground by metres.
    x, y = grid(N)
    faces_north = np.gradient(rolling(x, y), axis=0) < -0.1
    patch = faces_north & (x < 50)
    dsm = moved(tmp_path / "d.tif", N, (0.5, -0.5, 0), change=lambda z: z + 6.0 * patch)
    east, north, _ = found(dsm, reference)
    assert (east, north) == pytest.approx((0.5, -0.5), abs=NOISY_CONVERGED_SHIFT_M)


def test_it_is_found_between_other_grids(tmp_path, reference):
    at = (np.arange(160) + 0.5) * 0.8 - 2.0
    z = rolling(*np.meshgrid(at, at)).astype(np.float32)
    dsm = write(tmp_path / "d.tif", z, from_origin(WEST - 2.0 + 1.1, NORTH + 2.0 + 0.6, 0.8, 0.8))
    east, north, _ = found(dsm, reference)
    assert (east, north) == pytest.approx((1.1, 0.6), abs=OTHER_GRID_CONVERGED_SHIFT_M)


def test_noise_of_the_reference_is_no_slope_that_pulls(tmp_path):
    rng = np.random.default_rng(5)
    # As steep as the ground between neighbours: each step finds half of what is left.
    noisy = moved(tmp_path / "r.tif", N, (0, 0, 0), change=lambda z: z + rng.normal(0, 0.3, z.shape))
    dsm = moved(tmp_path / "d.tif", N, (1.5, -2.0, 0))
    east, north, _ = found(dsm, noisy)
    assert (east, north) == pytest.approx((1.5, -2.0), abs=NOISY_CONVERGED_SHIFT_M)


def test_what_is_left_does_not_move_again(tmp_path, reference):
    surface, heights = read_heights(moved(tmp_path / "d.tif", N, (1.0, 2.0, 3.0))), read_heights(reference)
    truth = truth_blocks(heights, 10.0, None)
    first = coregister(surface, truth, Points(truth.xy))
    again = coregister(surface, truth, Points(Points(truth.xy).moved((first.east_m, first.north_m))))
    assert again.steps == 1
    assert np.hypot(again.east_m, again.north_m) < CONVERGED_SHIFT_M


def test_the_shift_is_said_with_the_figures_before(tmp_path, reference):
    result = evaluate(moved(tmp_path / "d.tif", N, (1.0, 2.0, 3.0)), Comparison(reference, coregister="nuth-kaab"))
    table, record = evaluation_table(result), result.as_dict()
    assert "aligned: removed first: +1.000 m east, +2.000 m north, +3.000 m up (nuth-kaab, " in table
    assert record["shift_method"] == "nuth-kaab"
    assert record["shift_m"]["north"] == pytest.approx(2.0, abs=EXACT_CONVERGED_SHIFT_M)
    assert record["unshifted"]["median"] == pytest.approx(3.0, abs=1.0)
    assert record["all"]["rmse"] < 0.01
    assert record["aligned"]["all"] == record["all"]
    assert record["absolute"]["all"] == record["unshifted"]
    assert record["aligned"]["shift_method"] == "nuth-kaab"


@pytest.mark.parametrize(
    "ground",
    [
        lambda x, _: np.zeros_like(x),
        lambda x, y: 0.3 * x - 0.2 * y,
        lambda x, _: 4 * np.sin(x / 12),
        lambda x, y: 4 * np.sin(x / 12) + 0.3 * y,
        lambda x, _: np.random.default_rng(3).normal(0, 0.1, x.shape),
    ],
    ids=["flat", "tilted", "one direction", "the other tilted", "flat but for noise"],
)
def test_too_flat_ground_is_refused(tmp_path, ground):
    reference, dsm = (moved(tmp_path / f"{name}.tif", N, (0, 0, 0), ground) for name in "rd")
    with pytest.raises(InputError, match=r"too flat to co-register: in one direction its slopes differ by 0\.\d %"):
        evaluate(dsm, Comparison(reference, coregister="nuth-kaab"))


def rough(seed, sigma_cells=12):
    """Ground that is not like that of another seed."""
    z = gaussian_filter(np.random.default_rng(seed).normal(size=(N + 60, N + 60)), sigma_cells)[30:-30, 30:-30]
    return 4 * z / z.std()


def test_no_convergence_is_said(tmp_path, reference, monkeypatch):
    monkeypatch.setattr("zlocus.evaluation.coregistration.MAX_ITERATIONS", 2)
    says = "did not converge: after 2 steps it had moved it by .* m east and .* m north, the last time by .* m\\. Align"
    with pytest.raises(InputError, match=says):
        evaluate(moved(tmp_path / "d.tif", N, (4.0, 2.0, 3.0)), Comparison(reference, coregister="nuth-kaab"))


def test_other_ground_is_refused(tmp_path, reference):
    # Some shift fits even noise a little better than those around it.
    for seed in range(3):
        noise = moved(tmp_path / "noise.tif", N, (0, 0, 0), lambda *_, seed=seed: 30 * rough(seed, 0))
        with pytest.raises(InputError, match=r"known to|did not converge"):
            evaluate(noise, Comparison(reference, coregister="nuth-kaab"))


@pytest.mark.parametrize(("most_cells", "is_refused"), [(0.01, True), (0.02, False)])
def test_a_shift_that_is_not_known_well_is_refused(tmp_path, reference, monkeypatch, most_cells, is_refused):
    # It is known to 6 mm; a hundredth of a cell are 5 mm.
    monkeypatch.setattr("zlocus.evaluation.coregistration.MAX_SIGMA_CELLS", most_cells)
    rng = np.random.default_rng(1)
    dsm = moved(tmp_path / "d.tif", N, (1.0, -0.5, 0), change=lambda z: z + rng.normal(0, 0.3, z.shape))
    if is_refused:
        with pytest.raises(InputError, match=r"the shift would be known to 0\.00\d+ m, and 0\.005 m are needed"):
            evaluate(dsm, Comparison(reference, coregister="nuth-kaab"))
    else:
        assert evaluate(dsm, Comparison(reference, coregister="nuth-kaab")).shift.sigma_m < 0.01


def test_the_shift_is_as_precise_as_it_says(tmp_path, reference):
    # At whole cells, where no interpolation averages the noise.
    shifts = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        dsm = moved(tmp_path / "d.tif", N, (1.0, -0.5, 0), change=lambda z, rng=rng: z + rng.normal(0, 0.3, z.shape))
        shifts.append(evaluate(dsm, Comparison(reference, coregister="nuth-kaab")).shift)
    errors = np.array([(shift.east_m - 1.0, shift.north_m + 0.5) for shift in shifts])
    sigma = np.array([shift.sigma_m for shift in shifts])
    # 0.3 m over slopes of 0.25 on 200 x 200 blocks; 32 errors tell a scatter to 1 / sqrt(64), with three times that.
    assert sigma == pytest.approx(0.006, rel=0.25)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(np.mean(sigma), rel=0.375)


def test_a_shift_as_long_as_the_landforms_is_found(tmp_path):
    # Hills some 20 m across, 20 m away.
    ground = np.pad(rough(0), 40, mode="wrap")
    one = write(tmp_path / "r.tif", ground[40:-40, 40:-40].astype(np.float32))
    other = write(tmp_path / "d.tif", ground[12:-68, 10:-70].astype(np.float32))
    east, north, _ = found(other, one)
    assert (east, north) == pytest.approx((15.0, -14.0), abs=EXACT_CONVERGED_SHIFT_M)


def test_a_reference_without_slopes_is_refused(tmp_path):
    # Every other row is missing: no block has its neighbours.
    def rows(z):
        z[::2] = np.nan
        return z

    reference = moved(tmp_path / "r.tif", N, (0, 0, 0), change=rows)
    with pytest.raises(InputError, match="have 0 blocks with a slope in common"):
        evaluate(reference, Comparison(reference, coregister="nuth-kaab"))


def test_too_little_in_common_is_said(tmp_path, reference):
    def one_corner(z):
        z[8:] = np.nan
        return z

    dsm = moved(tmp_path / "d.tif", N, (0, 0, 0), change=one_corner)
    with pytest.raises(InputError, match="blocks with a slope in common, fewer than the 100"):
        evaluate(dsm, Comparison(reference, coregister="nuth-kaab"))


def test_one_way_to_align_at_a_time(reference):
    with pytest.raises(ConfigError, match="both look for the shift"):
        evaluate(reference, Comparison(reference, align=True, coregister="nuth-kaab"))
    with pytest.raises(ConfigError, match=r"--coregister icp is not known\. Give nuth-kaab"):
        evaluate(reference, Comparison(reference, coregister="icp"))


def test_search_and_slopes_agree(tmp_path, reference):
    dsm = moved(tmp_path / "d.tif", N, (1.23, -0.68, 0.75))
    searched = evaluate(dsm, Comparison(reference, align=True)).shift
    assert (searched.east_m, searched.north_m) == pytest.approx(found(dsm, reference)[:2], abs=0.03)
