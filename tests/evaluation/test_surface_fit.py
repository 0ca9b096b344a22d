"""Fits of a surface to points and to surfaces: planted shifts and tilts, and what cannot be known."""

from __future__ import annotations

import numpy as np
import pytest
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter

from evaluation_rasters import CELL_M, NORTH, WEST, grid, rolling, write
from point_scenes import PLANTED, ground_points, surface, table, tilted
from zlocus.core.errors import InputError
from zlocus.evaluation import fit_sample
from zlocus.evaluation.fit_sample import RasterHeights, sample_of_points, sample_of_raster
from zlocus.evaluation.height_file import HeightFile
from zlocus.evaluation.point_reference import PointReference
from zlocus.evaluation.surface_fit import fit_surface, robust_scale, shortest_half, tukey_weight
from zlocus.io.points.ground_points import PointOptions

# The bars of a shift, and of a tilt over the scene.
SHIFT_M, TILT_M = 0.01, 0.01
# Noise of 0.3 m at 20 000 places: 7 mm sideways, times four; half a cell would be 250 mm.
NOISY_M = 0.03
MAX_SHIFT_M = 10.0
# A result may be off by so many of its standard deviations: passed by chance once in some ten thousand.
SIGMAS = 4.0
FLAT = {
    "flat": lambda x, y: 50 + 0 * x, "tilted": lambda x, y: 0.3 * x - 0.2 * y,
    "one direction": lambda x, y: np.sin(x / 9),
}  # fmt: skip


@pytest.fixture(autouse=True)
def few_places(monkeypatch):
    monkeypatch.setattr(fit_sample, "MAX_POINTS", 20_000)
    monkeypatch.setattr(fit_sample, "MAX_PLACES", 60_000)


def fitted(dsm, points, max_shift_m=MAX_SHIFT_M, **options):
    reference = PointReference.open(HeightFile.open(dsm), (points,), PointOptions(), None)
    return fit_surface(sample_of_points(reference, max_shift_m), max_shift_m, **options)


def fitted_to_raster(dsm, raster, **options):
    heights = RasterHeights.open(HeightFile.open(dsm), raster, None)
    return fit_surface(sample_of_raster(heights, MAX_SHIFT_M), MAX_SHIFT_M, **options)


def reference_raster(folder, cell_m=CELL_M, noise_m=0.0, side_m=200.0):
    x, y = grid(int(side_m / cell_m), cell_m)
    noise = np.random.default_rng(9).normal(0, noise_m, x.shape)
    return write(folder / "r.tif", (rolling(x, y) + noise).astype(np.float32), from_origin(WEST, NORTH, cell_m, cell_m))


@pytest.mark.parametrize("planted", [(0, 0, 0), PLANTED, (-6.4, 5.2, -40), (0.25, 9.1, 3)])
def test_a_planted_shift_is_recovered_at_points(tmp_path, planted):
    fit = fitted(surface(tmp_path, planted), table(tmp_path))
    assert fit.shift_m == pytest.approx(planted, abs=SHIFT_M)
    assert fit.undetermined is None
    assert not fit.has_tilt


def test_a_planted_tilt_is_recovered_at_points(tmp_path):
    dsm = surface(tmp_path, PLANTED, lambda z: tilted(z, 0.5, -0.3))
    fit = fitted(dsm, table(tmp_path), has_tilt=True)
    assert fit.shift_m == pytest.approx(PLANTED, abs=SHIFT_M)
    # At the corners of the scene, which carries the tilt of the moved surface.
    east, north = fit.offset(np.array([[WEST + 200, NORTH - 100], [WEST + 100, NORTH]])) - fit.offset(
        np.array([[WEST, NORTH - 100], [WEST + 100, NORTH - 200]])
    )
    assert (east, north) == pytest.approx((1.0, -0.6), abs=TILT_M)


@pytest.mark.parametrize("cell_m", [0.2, CELL_M, 1.0])
def test_a_planted_shift_is_recovered_on_surfaces(tmp_path, cell_m):
    fit = fitted_to_raster(surface(tmp_path), reference_raster(tmp_path, cell_m))
    assert fit.shift_m == pytest.approx(PLANTED, abs=SHIFT_M)


def test_a_planted_tilt_is_recovered_on_a_surface(tmp_path):
    dsm = surface(tmp_path, (0, 0, 0.5), lambda z: tilted(z, 0.5, -0.3))
    fit = fitted_to_raster(dsm, reference_raster(tmp_path), has_tilt=True)
    assert fit.offset(np.array([[WEST + 200, NORTH - 200], [WEST, NORTH]])) == pytest.approx(
        (0.5 + 0.5 + 0.3, 0.5 - 0.5 - 0.3), abs=TILT_M
    )


def test_noise_does_not_pull_the_shift_to_half_cells(tmp_path):
    rng = np.random.default_rng(3)
    # Interpolation averages noise most in the middle between cells, a fifth of a cell beside.
    dsm = surface(tmp_path, (2.1, -1.4, 0.2), lambda z: z + rng.normal(0, 0.3, z.shape))
    fit = fitted_to_raster(dsm, reference_raster(tmp_path, noise_m=0.1))
    assert fit.shift_m == pytest.approx((2.1, -1.4, 0.2), abs=NOISY_M)


def test_single_wrong_heights_do_not_hide_the_slopes(tmp_path):
    rng = np.random.default_rng(7)

    def spoiled(z):
        z = z + rng.normal(0, 0.3, z.shape)
        z[rng.random(z.shape) < 0.1] += 8
        return z

    fit = fitted(surface(tmp_path, change=spoiled), table(tmp_path, 3000))
    assert fit.undetermined is None
    off = np.abs(np.array(fit.shift_m) - PLANTED)
    assert (off[:2] < SIGMAS * fit.sigma_m[:2]).all()


def test_trees_changed_ground_and_gross_errors_have_no_weight(tmp_path):
    rng, (x, y) = np.random.default_rng(4), grid(400)

    def spoiled(z):
        z = z + 7.0 * (gaussian_filter(rng.normal(size=z.shape), 8) > 0.015)  # a third is woods
        z[(x > 120) & (y > 140)] -= 3.0  # a pit
        z[rng.random(z.shape) < 0.01] += 50
        z[100:140, 60:100] = np.nan
        return z

    fit = fitted(surface(tmp_path, PLANTED, spoiled), table(tmp_path, 4000))
    off = np.abs(np.array(fit.shift_m) - PLANTED)
    assert (off < 0.05).all(), off
    assert fit.n_used < 0.8 * fit.n


@pytest.mark.parametrize("ground", FLAT.values(), ids=FLAT)
@pytest.mark.parametrize("noise_m", [0.0, 0.2])
def test_on_flat_ground_the_horizontal_shift_is_held(tmp_path, ground, noise_m):
    rng = np.random.default_rng(5)
    dsm = surface(tmp_path, (0, 0, 0.75), lambda z: z + rng.normal(0, noise_m, z.shape), ground)
    fit = fitted(dsm, table(tmp_path, ground=ground))
    assert fit.undetermined is not None
    assert fit.shift_m == pytest.approx((0, 0, 0.75), abs=max(SHIFT_M, SIGMAS * fit.sigma_m[2]))
    assert fit.shift_m[:2] == (0.0, 0.0)
    record = fit.as_dict()
    assert record["offset_m"]["east"] is None
    assert record["horizontal_undetermined"] == fit.undetermined


@pytest.mark.parametrize("seed", range(3))
def test_correlated_noise_on_flat_ground_is_no_relief(tmp_path, seed):
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(400, 400)), 4)
    dsm = surface(tmp_path, (0, 0, 0), lambda z: z + 0.3 * noise / noise.std(), FLAT["flat"])
    assert fitted(dsm, table(tmp_path, ground=FLAT["flat"])).undetermined is not None


def test_the_uncertainty_respects_correlation_in_space(tmp_path):
    rng = np.random.default_rng(6)
    noise = {cells: gaussian_filter(rng.normal(size=(400, 400)), cells) for cells in (0, 12)}
    fits = {
        cells: fitted(
            surface(tmp_path, change=lambda z, n=n: z + 0.2 * n / n.std(), name=f"{cells}.tif"), table(tmp_path, 3000)
        )
        for cells, n in noise.items()
    }  # fmt: skip
    assert fits[12].sigma_m[2] > 4 * fits[0].sigma_m[2]
    for fit in fits.values():
        off = np.abs(np.array(fit.shift_m) - PLANTED)
        assert (off < SIGMAS * fit.sigma_m[:3]).all(), (off, fit.sigma_m)


def test_few_points_fix_the_height_and_the_tilt_only_where_they_spread(tmp_path):
    dsm = surface(tmp_path, (0, 0, 0.4))
    fit = fitted(dsm, table(tmp_path, 40))
    assert fit.undetermined == "40 places are compared, and 100 are needed"
    assert fit.shift_m[2] == pytest.approx(0.4, abs=SHIFT_M)
    with pytest.raises(
        InputError, match="2 places have a height in the surface and in the reference, and 3 are needed"
    ):
        fitted(dsm, table(tmp_path, 2))
    with pytest.raises(InputError, match=r"8 places .* and 10 are needed for a tilt"):
        fitted(dsm, table(tmp_path, 8), has_tilt=True)
    xyz = ground_points(200)
    xyz[:, 0] = WEST + 100 + 0.01 * (xyz[:, 1] - NORTH)
    xyz[:, 2] = rolling(xyz[:, 0] - WEST, NORTH - xyz[:, 1])
    path = tmp_path / "track.csv"
    path.write_text("x,y,z\n" + "".join(f"{a},{b},{c}\n" for a, b, c in xyz))
    with pytest.raises(InputError, match="lie nearly on one line, so the tilt across it is not known"):
        fitted(dsm, path, has_tilt=True)
    assert fitted(dsm, path).shift_m[2] == pytest.approx(0.4, abs=SHIFT_M)


def test_a_shift_beyond_the_search_is_not_taken(tmp_path):
    fit = fitted(surface(tmp_path, (9.0, 0, 0)), table(tmp_path), max_shift_m=2.0)
    assert fit.undetermined is not None
    assert fit.shift_m[:2] == (0.0, 0.0)


def test_the_height_alone_on_request(tmp_path):
    fit = fitted(surface(tmp_path, (0, 0, 0.3)), table(tmp_path), is_vertical=True)
    assert fit.undetermined == "it was not asked for"
    assert fit.shift_m == pytest.approx((0, 0, 0.3), abs=SHIFT_M)


def test_the_shortest_half_and_its_scale():
    assert shortest_half(np.array([0.0, 10, 11, 12, 50])) == (11.0, 2.0)
    assert shortest_half(np.array([3.0])) == (3.0, 0.0)
    normal = np.random.default_rng(0).normal(5, 0.3, 100_000)
    assert robust_scale(normal) == pytest.approx(0.3, abs=0.01)
    spoiled = np.concatenate([normal[:60_000], normal[60_000:] + 8])
    assert shortest_half(spoiled)[0] == pytest.approx(5, abs=0.1)
    assert tukey_weight(np.array([0.0, 10.0, -10.0]), 1.0).tolist() == [1.0, 0.0, 0.0]
