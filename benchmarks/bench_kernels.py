"""Speed of the kernels on one core, on synthetic views of about the size of a small tile.

Kernels are compiled before they are timed. `extra_info` holds the figure of each in its own unit (ns per cell, step and
image, or cell-steps per second), the machine and the number of threads. SGM is compared with OpenCV's StereoSGBM on the
same number of pixels x disparities.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from zlocus.matching.evidence import BEST_SHARE, NO_COUNTS, NO_EVIDENCE
from zlocus.matching.free_rays import pair_agreement
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.kernels.cost_volume import CostParameters, SlopeArrays, tile_costs
from zlocus.matching.kernels.coverage import ViewMasks, block_coverage
from zlocus.matching.kernels.evidence import TABLE_SHAPE, EvidenceTable, TableAndCounts
from zlocus.matching.kernels.free_rays import add_ray_costs, lowest_free_ray
from zlocus.matching.kernels.mgm import sweep_quarter
from zlocus.matching.kernels.occlusion import lowest_visible
from zlocus.matching.kernels.prior_costs import CoarserCells, add_costs_of_candidates
from zlocus.matching.kernels.resample import flat_cells, image_of, resample_plane, resample_scratch
from zlocus.matching.kernels.sgm import sweep
from zlocus.matching.kernels.shared_records import (
    AxisGrid,
    BlockGrid,
    HeightSpan,
    PixelVelocity,
    ViewArrays,
    VisibleHeights,
)
from zlocus.matching.kernels.smooth import slopes, smooth_surface
from zlocus.matching.kernels.spline import spline_coefficients
from zlocus.matching.kernels.subpixel import CUBIC, ProfileSampling, tile_ortho, tile_profile
from zlocus.matching.kernels.winners import winner_takes_all, winners
from zlocus.matching.local_planes import mean_of_planes
from zlocus.matching.prior_costs import CANDIDATE_REACH, COST_OF_CANDIDATES
from zlocus.matching.subpixel import smoothed
from zlocus.matching.uncertain_heights import with_medians
from zlocus.products.hillshade import hillshade

SIDE, BLOCK, ROUNDS = 320, 32, 5
SGM_SIDE = 576
HIGHEST = 10_000


@dataclass(frozen=True)
class Case:
    """A kernel on its scene. call : runs one pass; n : units of work of a pass; unit : name of the unit."""

    call: Callable[[], object]
    n: int
    unit: str


def processor() -> str:
    """Name of the processor, from the system."""
    listed = Path("/proc/cpuinfo")
    lines = listed.read_text().splitlines() if listed.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def timed(benchmark, case: Case) -> float:
    """Time a case, after a call that compiles it; ns per unit and units per second go to `extra_info`."""
    case.call()
    seconds = []

    def once():
        start = time.thread_time()
        case.call()
        seconds.append(time.thread_time() - start)

    benchmark.pedantic(once, rounds=ROUNDS)
    best, n, unit = min(seconds), case.n, case.unit
    benchmark.extra_info.update(
        {f"ns per {unit}": best / n * 1e9, f"{unit} per s": n / best, "threads": 1, "machine": processor()}
    )
    return best


def views(n_views: int, side: int = SIDE):
    """Pixels, layout, nodes, bends (none) and heights of synthetic views; neighbouring heights are half a pixel
    apart."""
    rng = np.random.default_rng(7)
    px = side + 96
    corners = np.mgrid[: side // BLOCK + 1, : side // BLOCK + 1] * BLOCK
    nodes = np.zeros((n_views, *corners.shape[1:], 2, 4))
    for i in range(n_views):
        nodes[i, ..., 0, 0] = 48 + 0.99 * corners[1] + 0.02 * (i - 1) * corners[0]
        nodes[i, ..., 1, 0] = 48 + 1.01 * corners[0] - 0.01 * i * corners[1]
        nodes[i, ..., 0, 1] = 16.0 * (i % 3 - 1)
        nodes[i, ..., 1, 1] = 3.0 * i
    pixels = rng.normal(size=n_views * px * px).astype(np.float32)
    layout = np.array([(i * px * px, px, px) for i in range(n_views)], np.int64)
    bends = np.empty((n_views, *np.subtract(nodes.shape[1:3], 1), 2, 2, 0))
    return pixels, layout, nodes, bends, np.array([-1.0, 2.0 / 64.0])


def all_visible(n_views: int, side: int = SIDE) -> VisibleHeights:
    """Every view sees every cell at every height."""
    low = np.zeros((n_views, side, side), np.int32)
    return VisibleHeights(low, np.full_like(low, HIGHEST), low)


def lattice(side: int, count: int | None) -> HeightLattice:
    """A height lattice with one range for all blocks, or, as on real scenes, with 16 to 64 heights by block."""
    rng = np.random.default_rng(3)
    blocks = (side // BLOCK, side // BLOCK)
    first = np.zeros(blocks, np.int64) if count else rng.integers(0, 41, blocks)
    counts = np.full(blocks, count, np.int64) if count else 16 * rng.integers(1, 5, blocks)
    return HeightLattice(0.0, 1.0, (side, side), BLOCK, first.astype(np.int64), counts.astype(np.int64))


def city_lattice(side: int) -> HeightLattice:
    """A height lattice as on the finest level of a town: multiples of 4 from 4 to 156 heights, mean 25, median 16."""
    rng = np.random.default_rng(3)
    blocks = (-(-side // BLOCK),) * 2
    count = np.clip(4 * np.rint(np.exp(rng.normal(np.log(16.0), 0.95, blocks)) / 4), 4, 156).astype(np.int64)
    return HeightLattice(0.0, 1.0, (side, side), BLOCK, rng.integers(-6, 7, blocks) - count // 2, count)


def rolling(side: int = SIDE) -> np.ndarray:
    """A smooth surface of height indices."""
    r, c = np.mgrid[:side, :side].astype(np.float32)
    return (32 + 8 * np.sin(r / 30) * np.cos(c / 40)).astype(np.float32)


def resample_case() -> Case:
    """Bilinear samples of one view on the plane of a block and its margin."""
    image, side = image_of(ViewArrays(*views(1), BLOCK), 0), BLOCK + 6
    grid = BlockGrid(AxisGrid(60.3, 0.99, -0.02, 0.0, 0.0, 0.0), AxisGrid(60.7, 0.01, 1.01, 0.0, 0.0, 0.0))
    cells, scratch = flat_cells(side, side), resample_scratch(side * side)
    relief, out = np.zeros(side * side, np.float32), np.empty(side * side, np.float32)
    velocity = PixelVelocity(np.float32(0.5), np.float32(0.1))

    def call():
        for _ in range(500):
            resample_plane(image, grid, velocity, cells, relief, scratch, out)

    return Case(call, 500 * side * side, "sample")


def some_evidence(n_views: int) -> TableAndCounts:
    """A table of evidence. What it holds does not change the time, but no two pairs of views are worth the same."""
    rng = np.random.default_rng(9)
    ratios = rng.uniform(-2, 3, int(np.prod(TABLE_SHAPE)) + 1).astype(np.float32)
    worth = rng.uniform(0.5, 1.5, (n_views, n_views)).astype(np.float32)
    values = (np.float32(value) for value in (0.01, 14.0, 18.0, 3.0, 0.5, 0.3, 160.0))
    grey_unit = rng.uniform(0.5, 1.5, (n_views, n_views)).astype(np.float32)
    return TableAndCounts(EvidenceTable(ratios, *values, grey_unit, worth, np.float32(BEST_SHARE)), NO_COUNTS)


def costs_case(
    n_views: int, windows: list[int], weight: float, side: int = SIDE, evidence: TableAndCounts = NO_EVIDENCE
) -> Case:
    """Costs of a tile: half widths of its windows, weight of grey differences."""
    heights = lattice(side, 32)
    volume = np.zeros(heights.size, np.uint8)
    visible, half = all_visible(n_views, side), np.array(windows, np.int64)
    values = (np.float32(value) for value in (0.0, weight, weight, 0.3, 0.5))
    parameters, wide = CostParameters(*values, n_views, np.float32(0.0)), side + 2 * max(windows)
    slope = SlopeArrays(np.zeros((wide, wide), np.float32), np.zeros((side // BLOCK + 1, side // BLOCK + 1)))
    arrays, layout = ViewArrays(*views(n_views, side), BLOCK), heights.layout

    def call():
        tile_costs(arrays, slope, layout, half, visible, parameters, evidence, volume)

    return Case(call, heights.size * n_views, "cell, step and image")


def candidates_case(side: int = SIDE) -> Case:
    """Costs of heights far from the candidates of a coarser level, on ragged ranges."""
    heights, rng = lattice(side, None), np.random.default_rng(11)
    cost = np.zeros(heights.size, np.uint8)
    found = rng.integers(0, 16, (3, side // 2, side // 2)).astype(np.int32)
    flat, cells = np.zeros((side, side), np.float32), CoarserCells(0, 0, CANDIDATE_REACH)

    def call():
        add_costs_of_candidates(cost, heights.layout, flat, found, cells, COST_OF_CANDIDATES)

    return Case(call, heights.size, "cell-step")


def sums_scene(side: int, heights: HeightLattice):
    """Costs, penalties and sums of a volume."""
    rng = np.random.default_rng(5)
    cost = rng.integers(0, 129, heights.size).astype(np.uint8)
    p2 = rng.integers(60, 240, (4, side, side)).astype(np.uint16)
    return cost, p2, np.zeros(heights.size, np.uint16)


def sgm_case(count: int | None, side: int = SGM_SIDE) -> Case:
    """Semi-global aggregation along eight paths, with `count` heights in all cells or ragged ranges."""
    side = side // 2 if count == 128 else side
    heights = lattice(side, count)
    cost, p2, total = sums_scene(side, heights)

    def call():
        for sign in (1, -1):
            sweep(cost, heights.layout, p2, np.uint16(20), sign, total)

    return Case(call, heights.size, "cell-step")


def mgm_case(count: int | str | None, side: int = SGM_SIDE) -> Case:
    """Aggregation with two predecessors (MGM), eight directions; as `sgm_case`, or with the ranges of a town."""
    heights = city_lattice(side) if count == "city" else lattice(side, count)
    cost, p2, total = sums_scene(side, heights)

    def call():
        for turn in range(4):
            sweep_quarter(cost, heights.layout, p2, np.uint16(20), turn, total)

    return Case(call, heights.size, "cell-step")


def winners_case(count: int | None, side: int = SGM_SIDE) -> Case:
    """Winners: heights with the least sum of path costs."""
    heights = lattice(side, count)
    total = np.random.default_rng(5).integers(100, 2000, heights.size).astype(np.uint16)
    shape = heights.shape
    best, second = np.empty(shape, np.int32), np.empty(shape, np.int32)
    margin, vertex = np.empty(shape, np.uint16), np.empty(shape, np.float32)

    def call():
        winners(total, heights.layout, best, second, margin, vertex)

    return Case(call, heights.size, "cell-step")


def least_case(count: int | None, side: int = SGM_SIDE) -> Case:
    """Heights with the least cost of a cell itself, beside the winners of the sums."""
    heights = lattice(side, count)
    rng, (first, counts) = np.random.default_rng(5), heights.cell_ranges()
    cost = rng.integers(0, 255, heights.size).astype(np.uint8)
    best, lone = (first + rng.integers(0, counts)).astype(np.int32), np.empty(heights.shape, np.int32)

    def call():
        winner_takes_all(cost, heights.layout, best, lone)

    return Case(call, heights.size, "cell-step")


def profile_case(side: int = SIDE) -> Case:
    """Correlations at three offsets around a surface, cubic resampling, windows 5 x 5 and 9 x 9, three views."""
    half, offsets = 4, np.linspace(-0.5, 0.5, 3).astype(np.float32)
    surface, visible = np.pad(rolling(side), half, mode="edge"), all_visible(3, side)
    out, arrays = np.empty((2, 1, len(offsets), side, side), np.float32), ViewArrays(*views(3, side), BLOCK)
    sampling = ProfileSampling(CUBIC, offsets, np.array([2, half]), np.float32(0))

    def call():
        tile_profile(arrays, surface, sampling, visible, out)

    return Case(call, out[0].size * 3, "cell, offset and image")


def smooth_case(side: int = SIDE) -> Case:
    """Smoothing of a surface: one pass of 25 taps, two cells apart."""
    surface = rolling(side)
    by_row, by_col, out = np.empty_like(surface), np.empty_like(surface), np.empty_like(surface)
    slopes(surface, 8, by_row, by_col)
    return Case(lambda: smooth_surface(surface, by_row, by_col, 2, np.float32(2.0), out), surface.size, "cell")


def local_planes_case(side: int = SIDE) -> Case:
    """Planes of windows of three sides around every cell, of a surface with noise and a few unknown cells."""
    rng = np.random.default_rng(5)
    height = rolling(side) + rng.normal(0, 0.3, (side, side)).astype(np.float32)
    sigma, is_known = np.full(height.shape, 0.4, np.float32), rng.random(height.shape) < 0.98
    return Case(
        lambda: [mean_of_planes(height, sigma, is_known, of_window) for of_window in (5, 9, 17)],
        3 * height.size, "cell and side of windows",
    )  # fmt: skip


def weighted_median_case(side: int = SIDE) -> Case:
    """Weighted medians around the cells of a noisy surface, a third of which are uncertain."""
    rng = np.random.default_rng(6)
    height = rolling(side) + rng.normal(0, 2.0, (side, side)).astype(np.float32)
    sigma = np.where(rng.random(height.shape) < 1 / 3, 6.0, 0.5).astype(np.float32)
    grey, is_known = rng.normal(0, 1, height.shape).astype(np.float32), np.ones(height.shape, np.bool_)
    return Case(lambda: with_medians(height, sigma, grey, is_known, 2.0, 1.0), height.size, "cell")


def visibility_case(by_col: float = 0.4, by_row: float = 0.2, side: int = SIDE) -> Case:
    """Occlusion of a surface in one view; by_col, by_row : parallax rate, which decides the direction of the sweep."""
    surface = rolling(side)
    out = np.empty_like(surface)
    return Case(lambda: lowest_visible(surface, by_col, by_row, out), surface.size, "cell")


def free_ray_case(by_col: float = 0.4, by_row: float = 0.2, side: int = SIDE) -> Case:
    """The lowest ray of a view to a surface of which the view sees two thirds."""
    surface, out = rolling(side), np.empty((side, side), np.float32)
    supported = np.random.default_rng(2).random(surface.shape) < 0.67
    return Case(lambda: lowest_free_ray(surface, supported, by_col, by_row, out), surface.size, "cell")


def ray_costs_case(side: int = SIDE, n_views: int = 6, count: int = 32) -> Case:
    """Costs of free rays on a volume; in a tenth of the cells two views have a ray below some of the heights."""
    rng = np.random.default_rng(3)
    blocks = (-(-side // BLOCK), -(-side // BLOCK))
    lattice = HeightLattice(0.0, 1.0, (side, side), BLOCK, np.zeros(blocks, np.int64), np.full(blocks, count, np.int64))
    rays = np.full((n_views, side, side), np.inf, np.float32)
    crossed = rng.random((side, side)) < 0.1
    rays[:2, crossed] = rng.uniform(0, count, (2, int(crossed.sum())))
    base, cost = np.zeros((side, side), np.float32), np.zeros(lattice.size, np.uint8)

    def call():
        add_ray_costs(rays, base, lattice.layout, 12, 80, cost)

    return Case(call, side * side, "cell")


def agreement_case(n_views: int = 6, side: int = SIDE) -> Case:
    """Agreement of the images on a surface, all pairs of images."""
    grey = np.random.default_rng(4).normal(size=(n_views, side, side)).astype(np.float32)
    covers = np.ones(grey.shape, np.bool_)
    return Case(lambda: pair_agreement(grey, covers), side * side * n_views * (n_views - 1) // 2, "cell and pair")


def reach_case() -> Case:
    """Visible height range of a block that the borders of three images cross at each of 64 heights (the slow case)."""
    pixels, layout, nodes, bends, heights = views(3)
    layout[:, 2] = 48 + BLOCK // 2
    span, low, high = HeightSpan(0, 64), np.full(3, -1), np.full(3, 64)
    lowest, highest = np.empty((3, BLOCK, BLOCK), np.int32), np.empty((3, BLOCK, BLOCK), np.int32)
    masks = ViewMasks(np.zeros(pixels.shape, bool), np.zeros(3, bool))
    arrays = ViewArrays(pixels, layout, np.ascontiguousarray(nodes[:, :2, :2]), bends[:, :1, :1], heights, BLOCK)

    def call():
        for _ in range(50):
            block_coverage(arrays, masks, span, low, high, 3.0, lowest, highest)

    return Case(call, 50 * span.n_heights * lowest.size, "cell, step and image")


def spline_case() -> Case:
    """Spline coefficients of an image."""
    image = np.random.default_rng(7).normal(size=(1200, 1000)).astype(np.float32)
    return Case(lambda: spline_coefficients(image), image.size, "pixel")


def ortho_case(side: int = SIDE) -> Case:
    """Ortho-image of one view on a surface, bilinear."""
    surface, arrays, out = rolling(side), ViewArrays(*views(1, side), BLOCK), np.empty((side, side), np.float32)
    is_wanted = np.ones(np.subtract(arrays.nodes.shape[1:3], 1), np.bool_)
    return Case(lambda: tile_ortho(arrays, surface, 0, is_wanted, out), out.size, "cell")


def test_resample(benchmark):
    timed(benchmark, resample_case())


@pytest.mark.parametrize(
    ("n_views", "windows", "weight"),
    [(2, [3], 0.0), (3, [1, 2], 0.0), (3, [1, 2], 1.0), (6, [1, 2], 1.0)],
    ids=["2-views-7x7", "3-views-3x3-5x5", "3-views-3x3-5x5-greys", "6-views-3x3-5x5-greys"],
)
def test_costs(benchmark, side, n_views, windows, weight):
    case = costs_case(n_views, windows, weight, side or SIDE)
    seconds = timed(benchmark, case)
    if windows == [3]:
        benchmark.extra_info["resample_ncc_ns"] = seconds / case.n * 1e9


@pytest.mark.parametrize(
    ("n_views", "windows"), [(2, [1, 2]), (3, [1, 2]), (6, [1])], ids=["2-views", "3-views", "6-views-3x3"]
)
def test_costs_of_evidence(benchmark, side, n_views, windows):
    timed(benchmark, costs_case(n_views, windows, 1.0, side or SIDE, some_evidence(n_views)))


def test_costs_of_candidates(benchmark, side):
    timed(benchmark, candidates_case(side or SIDE))


@pytest.mark.parametrize("count", [16, 32, 64, 128, None], ids=["16", "32", "64", "128", "ragged"])
def test_sgm(benchmark, side, count):
    case = sgm_case(count, side or SGM_SIDE)
    seconds = timed(benchmark, case)
    if count == 64:
        benchmark.extra_info["sgm_cell_steps_per_s"] = case.n / seconds
        benchmark.extra_info["opencv_hh_cell_steps_per_s"] = opencv_speed(side or SGM_SIDE, count)


@pytest.mark.parametrize("count", [16, 32, 64, None, "city"], ids=["16", "32", "64", "ragged", "city"])
def test_mgm(benchmark, side, count):
    timed(benchmark, mgm_case(count, side or SGM_SIDE))


def opencv_speed(side: int, n_disparities: int) -> float:
    """Pixels x disparities per second of StereoSGBM over 8 paths, with its cost, on a pair with `side`^2 matches."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    right = np.random.default_rng(2).integers(0, 256, (side, side + n_disparities)).astype(np.uint8)
    right = cv2.GaussianBlur(right, (5, 5), 0)
    left = np.roll(right, n_disparities // 3, axis=1)
    matcher = cv2.StereoSGBM_create(
        minDisparity=0, numDisparities=n_disparities, blockSize=3, P1=20, P2=240, mode=cv2.STEREO_SGBM_MODE_HH
    )
    seconds = []
    for _ in range(ROUNDS):
        start = time.thread_time()
        matcher.compute(left, right)
        seconds.append(time.thread_time() - start)
    cv2.setNumThreads(threads)
    return side * side * n_disparities / min(seconds)


@pytest.mark.parametrize("count", [32, None], ids=["32", "ragged"])
def test_winners(benchmark, side, count):
    timed(benchmark, winners_case(count, side or SGM_SIDE))


@pytest.mark.parametrize("count", [32, None], ids=["32", "ragged"])
def test_least_costs(benchmark, side, count):
    timed(benchmark, least_case(count, side or SGM_SIDE))


def test_profile(benchmark, side):
    timed(benchmark, profile_case(side or SIDE))


def test_smooth(benchmark, side):
    surface = rolling(side or SIDE)
    timed(benchmark, Case(lambda: smoothed(surface, 2.0), surface.size, "cell"))


def test_local_planes(benchmark, side):
    timed(benchmark, local_planes_case(side or SIDE))


def test_weighted_medians(benchmark, side):
    timed(benchmark, weighted_median_case(side or SIDE))


def test_visibility(benchmark, side):
    timed(benchmark, visibility_case(side=side or SIDE))


def test_free_rays(benchmark, side):
    timed(benchmark, free_ray_case(side=side or SIDE))


def test_ray_costs(benchmark, side):
    timed(benchmark, ray_costs_case(side or SIDE))


def test_agreement(benchmark, side):
    timed(benchmark, agreement_case(side=side or SIDE))


def test_shade(benchmark, side):
    """Hillshade as in hillshade.tif, with one empty cell in a hundred."""
    surface = rolling(side or SIDE)
    surface[np.random.default_rng(1).random(surface.shape) < 0.01] = np.nan
    timed(benchmark, Case(lambda: hillshade(surface, 0.5, 315.0, 45.0), surface.size, "cell"))


def test_reach(benchmark):
    timed(benchmark, reach_case())


def test_spline(benchmark):
    timed(benchmark, spline_case())


def test_ortho(benchmark, side):
    timed(benchmark, ortho_case(side or SIDE))
