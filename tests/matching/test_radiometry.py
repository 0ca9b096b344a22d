"""Grey values of views with other exposures and footprints, on one scale over the ground that they share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from inspect import signature
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.sparse.linalg import LinearOperator, cg

from orientation_scenes import BASE_HEIGHT_M, GSD_M, AffineSensor, ArrayImage, image_of
from zlocus.core.scene import View
from zlocus.matching.radiometry import (
    MAX_POINTS,
    MIN_POINTS,
    PART_PX,
    RELATIVE_TOLERANCE,
    SAMPLE_ROWS,
    SQUARE_PX,
    conjugate_gradients,
    grey_at,
    grey_scales,
    image_grey,
)
from zlocus.matching.view_pixels import PixelWindow, read_pixels

SIZE_PX, GROUND_PX = 160, 400
# Grey value of an albedo of 0 in each view, and by how much it grows per unit of albedo.
EXPOSURES = ((200.0, 100.0), (900.0, 40.0), (-50.0, 250.0))
EAST_PX = (0, 80, -80)
# What grows by u, by v, and by the square of the distance from the centre, of each view.
TRENDS = ((1.6, 0.0, 0.0), (0.0, -1.2, 1.0), (-1.4, 0.6, -0.8))
# Where the field starts that only the second view sees, and how much brighter it is.
FIELD_PX, BRIGHTER = 90, 6.0
# Units of albedo, of which the ground's deviation is 1; and a share of a gain.
ALBEDO, GAIN = 0.02, 0.02
FLOAT32_GREY = 1e-3


@pytest.mark.skipif(
    "rtol" not in signature(cg).parameters,
    reason="SciPy before 1.12 has conjugate gradients in Fortran: other last bits",
)
def test_conjugate_gradients_are_those_of_scipy():
    """To the last bit: from 0 and from elsewhere, with a preconditioner; and for a right side of 0."""
    rng = np.random.default_rng(3)
    for size in (1, 6, 30):
        root = rng.normal(size=(size, size))
        matrix, scale = root @ root.T + np.eye(size), rng.uniform(0.1, 2.0, size)
        inverse = LinearOperator((size, size), matvec=lambda v, scale=scale: scale * v, dtype=float)
        for right, first in (
            (rng.normal(size=size), np.zeros(size)), (rng.normal(size=size), rng.normal(size=size)),
            (np.zeros(size), np.ones(size)),
        ):  # fmt: skip
            expected, _ = cg(matrix, right, first, rtol=RELATIVE_TOLERANCE, M=inverse)
            found = conjugate_gradients(lambda v, matrix=matrix: matrix @ v, right, first, inverse.matvec)
            np.testing.assert_array_equal(found, expected)


def albedo():
    """(GROUND_PX, GROUND_PX), a value per GSD_M around the scene's centre."""
    ground = gaussian_filter(np.random.default_rng(5).normal(size=(GROUND_PX, GROUND_PX)), 8, mode="wrap")
    ground /= ground.std()
    ground[:, GROUND_PX // 2 + FIELD_PX :] += BRIGHTER
    return ground


def view_of(ground, index, noise=0.0, valid=None):
    """Looking straight down, EAST_PX east of the centre."""
    offset, gain = EXPOSURES[index]
    top, left = (GROUND_PX - SIZE_PX) // 2, (GROUND_PX - SIZE_PX) // 2 + EAST_PX[index]
    seen = ground[top : top + SIZE_PX, left : left + SIZE_PX]
    seen = seen + noise * np.random.default_rng([1, index]).normal(size=seen.shape)
    sensor = AffineSensor(0.0, 0.0, (SIZE_PX / 2 - EAST_PX[index], SIZE_PX / 2))
    return View(f"v{index}", Path(f"v{index}.tif"), image_of(offset + gain * seen, valid), sensor)


def points(n, east_px=(-80.0, 80.0), seed=2):
    """Ground points whose squares lie inside the images that see them."""
    rng = np.random.default_rng(seed)
    east = rng.uniform(east_px[0] + SQUARE_PX, east_px[1] - SQUARE_PX, n)
    north = rng.uniform(-70, 70, n)
    return np.column_stack([east * GSD_M, north * GSD_M, np.full(n, BASE_HEIGHT_M)])


def moments_of(scales):
    """Mean and contrast of every view, which has no trend."""
    assert all(scale.trend is None for scale in scales)
    return [(scale.mean, scale.contrast) for scale in scales]


def albedos_of(scales):
    """What the grey values that become 0 and 1 were on the ground: (i,) albedo and (i,) albedo per unit."""
    zero = [(mean - offset) / gain for (mean, _), (offset, gain) in zip(scales, EXPOSURES, strict=False)]
    unit = [deviation / gain for (_, deviation), (_, gain) in zip(scales, EXPOSURES, strict=False)]
    return np.array(zero), np.array(unit)


def test_views_of_other_ground_agree_where_they_look_at_the_same():
    """Whole images would not: the second shows a bright field, the third does not."""
    ground = albedo()
    views = tuple(view_of(ground, i) for i in range(3))
    zero, unit = albedos_of([image_grey(view) for view in views])
    assert np.ptp(zero) > 1
    assert unit.max() > 1.5 * unit.min()
    zero, unit = albedos_of(moments_of(grey_scales(views, points(300))))
    assert np.ptp(zero) < ALBEDO
    assert unit.max() < (1 + GAIN) * unit.min()


def test_a_shadow_that_moved_does_not_matter():
    """It darkens an eighth of the shared ground, in one view only."""
    ground, shaded = albedo(), albedo()
    shaded[160:200, 160:240] -= 4.0
    views = (view_of(ground, 0), view_of(shaded, 1), view_of(ground, 2))
    at = points(300)
    col, row = (at[:, :2] * [1, -1] / GSD_M + GROUND_PX / 2).T
    assert 0.1 < ((np.abs(col - 200) < 40) & (np.abs(row - 180) < 20)).mean() < 0.2
    zero, unit = albedos_of(moments_of(grey_scales(views, at)))
    assert np.ptp(zero) < ALBEDO
    assert unit.max() < (1 + GAIN) * unit.min()


@pytest.mark.parametrize(("n_seen", "keeps"), [(MIN_POINTS - 1, True), (MIN_POINTS, False)])
def test_a_view_that_shares_too_few_points_keeps_its_own_moments(n_seen, keeps):
    """However far the others, which differ by noise, are moved together."""
    views = tuple(view_of(albedo(), i, noise=3.0) for i in range(3))
    alone = points(60, (90.0, 160.0))
    at = np.concatenate([points(200, (-80.0, 0.0)), points(n_seen, (0.0, 80.0), seed=3), alone])
    assert np.isfinite(grey_at(views[1], at)).sum() == n_seen + len(alone)
    assert np.isnan(grey_at(views[0], alone)).all()
    scales, whole = moments_of(grey_scales(views, at)), [image_grey(view) for view in views]
    assert (scales[1] == whole[1]) == keeps
    assert scales[0] != whole[0]
    assert scales[2] != whole[2]


def test_ground_that_no_other_view_sees_says_nothing():
    views = (view_of(albedo(), 1), view_of(albedo(), 2))
    assert moments_of(grey_scales(views, points(300))) == [image_grey(view) for view in views]


@pytest.mark.parametrize("n_views", [1, 3])
def test_without_tie_points_images_keep_their_own_moments(n_views):
    views = tuple(view_of(albedo(), i) for i in range(n_views))
    assert moments_of(grey_scales(views, np.empty((0, 3)))) == [image_grey(view) for view in views]


@pytest.mark.parametrize("noise", [0.0, 3.0, 20.0])
def test_contrast_is_kept_over_all_views(noise):
    """The mean of noisy views has less contrast than each, round after round."""
    views = tuple(view_of(albedo(), i, noise) for i in range(3))
    found, whole = (
        np.array(s)[:, 1] for s in (moments_of(grey_scales(views, points(300))), [image_grey(v) for v in views])
    )
    assert np.abs(found / whole - 1).max() > GAIN
    assert np.log(found / whole).mean() == pytest.approx(0, abs=1e-9)


def test_order_of_views_does_not_matter():
    views, at = tuple(view_of(albedo(), i, noise=1.0) for i in range(3)), points(300)
    forth, back = (moments_of(grey_scales(v, at)) for v in (views, views[::-1]))
    np.testing.assert_allclose(back, forth[::-1], rtol=1e-9)


def brightened(view, a, b, c):
    """A view that is brighter towards one side and its corners: a u + b v + c (u^2 + v^2), in units of albedo."""
    v, u = np.mgrid[-1 : 1 : SIZE_PX * 1j, -1 : 1 : SIZE_PX * 1j] * (SIZE_PX - 1) / SIZE_PX
    gain = EXPOSURES[int(view.name[1])][1]
    return replace(view, image=image_of(view.image.pixels + gain * (a * u + b * v + c * (u * u + v * v))))


def test_what_one_side_of_an_image_has_more_is_taken_off():
    """Views that see the same ground with different sides agree on it, once their trends are taken off."""
    plain = tuple(view_of(albedo(), i) for i in range(3))
    views = tuple(brightened(v, *t) for v, t in zip(plain, TRENDS, strict=True))
    scales, at = grey_scales(views, points(300)), points(200, seed=7)
    left, before = [], []
    for view, scale in zip(views, scales, strict=True):
        assert scale.trend is not None
        read = read_pixels(view, PixelWindow(0, 0, SIZE_PX, SIZE_PX), scale)
        np.testing.assert_array_equal(read.trend, scale.trend.window(0, 0, SIZE_PX, SIZE_PX))
        part = read_pixels(view, PixelWindow(20, 30, 40, 50), scale)
        np.testing.assert_allclose(part.pixels, read.pixels[20:60, 30:80], rtol=0, atol=1e-4)
        for found, pixels in ((left, read.pixels), (before, (view.image.pixels - scale.mean) / scale.contrast)):
            found.append(grey_at(replace(view, image=image_of(pixels)), at))
    left, before = (np.nanstd(np.array(found) - np.nanmean(found, axis=0)) for found in (left, before))
    assert before > 0.2
    assert left < 0.15 * before


def test_noise_is_no_trend():
    views = tuple(view_of(albedo(), i, noise=1.0) for i in range(3))
    assert all(scale.trend is None for scale in grey_scales(views, points(300)))


@dataclass(frozen=True)
class CountedImage(ArrayImage):
    """Counts what is read of it."""

    windows: list[tuple[int, ...]]

    def read(self, *window):
        self.windows.append(window)
        return super().read(*window)


def test_a_scene_of_many_points_reads_few_and_from_all_of_it():
    windows: list[tuple[int, ...]] = []
    plain = view_of(albedo(), 0)
    counted = replace(plain, image=CountedImage(plain.image.pixels, plain.image.valid, windows))
    at = points(20 * MAX_POINTS)
    at = at[np.argsort(at[:, 0])]
    grey_scales((counted, view_of(albedo(), 1)), at)
    reads = [window for window in windows if window[2] > 1]
    assert len(reads) <= np.prod([-(-n // PART_PX) for n in counted.image.shape])
    assert len(windows) == len(reads) + SAMPLE_ROWS
    assert max(col + cols for _, col, _, cols in reads) - min(col for _, col, _, _ in reads) > 0.8 * SIZE_PX
    assert max(window[k] for window in reads for k in (2, 3)) <= PART_PX + SQUARE_PX


def test_grey_around_a_point():
    """Means over the square around the nearest pixel; none where it leaves the image or touches nodata."""
    row, col = np.indices((40, 50))
    valid = np.ones((40, 50), bool)
    valid[10, 10] = False
    view = View("v", Path("v.tif"), image_of(col + 100.0 * row, valid), AffineSensor(0.0, 0.0))
    half = SQUARE_PX // 2
    at_px = [(20.3, 30.4), (half, half), (half - 0.6, 20), (20, 39.6 - half), (49 - half, 39 - half),
             (10 + half, 10 + half), (10 + half + 1, 10), (np.nan, 3)]  # fmt: skip
    expected = [20 + 3000, half * 101, np.nan, np.nan, 49 - half + 100 * (39 - half), np.nan, 11 + half + 1000, np.nan]
    ground = view.sensor.ground_from_image(np.array(at_px), BASE_HEIGHT_M)
    np.testing.assert_allclose(grey_at(view, ground), expected, rtol=0, atol=FLOAT32_GREY)


def test_moments_of_an_image_are_those_of_valid_pixels():
    valid = np.ones((SIZE_PX, SIZE_PX), bool)
    valid[:, :50] = False
    view = view_of(albedo(), 0, valid=valid)
    pixels = view.image.pixels[:, 50:]
    mean, deviation = image_grey(view)
    assert mean == pytest.approx(pixels.mean(), abs=0.1 * float(pixels.std()))
    assert deviation == pytest.approx(pixels.std(), rel=0.1)
    assert image_grey(replace(view, image=image_of(np.full((40, 50), 7.0)))) == (7.0, 1.0)


def test_moments_of_an_image_whose_sampled_rows_are_nodata():
    """Valid rows may all fall between those that are read."""
    valid = np.zeros((1000, 20), bool)
    valid[3:9] = True
    blind = replace(view_of(albedo(), 0), image=image_of(np.random.default_rng(0).normal(size=(1000, 20)), valid))
    assert image_grey(blind) == (0.0, 1.0)
