"""Benchmarks of time and memory, run on small scenes: what they count, and that their figures are of the right kind."""

from __future__ import annotations

import csv
import json
import time
from dataclasses import replace
from pathlib import Path

import laspy
import numba
import numpy as np
import pytest
import rasterio

import bench_kernels
import cloud_files
import inspecting
import large
import machine
import roofline
import roofline_counts
import threads
from benchmark_scripts import printed_table, run_script, share_of
from rows import large_areas, resources
from workplace import CannotRun, Workplace, rendered_images
from zlocus.io.scene_file import open_scene

PERIOD_PX = 64
# A ground point is projected a period further to this, which is what a fitted RPC is good for.
PERIOD_TOLERANCE_PX = 0.02
# Rates of a core, 1e9 a second: slower than any on which this runs, and faster.
LEAST_RATE, MOST_RATE = 0.02, 5000.0


@pytest.fixture(scope="module")
def repeated_town():
    return large.town(PERIOD_PX)


def test_images_of_the_repeated_town_are_repeated(repeated_town, tmp_path):
    """In their pixels, and in what their RPCs say of the ground."""
    side = 2 * PERIOD_PX + 10
    paths = large.write_views(tmp_path, repeated_town, 2, side)
    for number, path in enumerate(paths):
        with rasterio.open(path) as file:
            grey = file.read(1)
        assert grey.shape == (side, side)
        shown = large.pixels(repeated_town, large.LOOKS[number], number)
        np.testing.assert_array_equal(grey[:PERIOD_PX, :PERIOD_PX], shown)
        np.testing.assert_array_equal(grey[:PERIOD_PX, :PERIOD_PX], grey[PERIOD_PX:-10, PERIOD_PX:-10])
        assert grey.std() > 20
    west, north, z = repeated_town.west_m, repeated_town.north_m, repeated_town.z[0]
    step_m = PERIOD_PX * large.GSD_M
    xyz = np.array([[west + 5, north - 5, z], [west + 5 + step_m, north - 5 - step_m, z]])
    for view in open_scene(paths).views:
        first, second = view.sensor.image_from_ground(xyz)
        np.testing.assert_allclose(second - first, PERIOD_PX, rtol=0, atol=PERIOD_TOLERANCE_PX)


def test_images_of_a_block_show_the_same_ground(repeated_town, tmp_path):
    """Neighbours overlap by half, and a ground point has the grey value of its image in the whole town."""
    half = PERIOD_PX // 2
    paths = large.write_block(tmp_path, repeated_town, 2)
    assert [path.name for path in paths] == ["b00_00.tif", "b00_01.tif", "b01_00.tif", "b01_01.tif"]
    step_m, middle_m = half * large.GSD_M, sum(repeated_town.z) / 2
    middle = np.array([[repeated_town.west_m + 1.5 * step_m, repeated_town.north_m - 1.5 * step_m, middle_m]])
    for view, (row, col) in zip(open_scene(paths).views, ((0, 0), (0, 1), (1, 0), (1, 1)), strict=True):
        ((x, y),) = view.sensor.image_from_ground(middle)
        # Whatever their direction, images of a point at the middle height lie side by side, half a period apart.
        assert x == pytest.approx((1.5 - col) * half - 0.5, abs=PERIOD_TOLERANCE_PX)
        assert y == pytest.approx((1.5 - row) * half - 0.5, abs=PERIOD_TOLERANCE_PX)
    whole = large.pixels(repeated_town, large.LOOKS[1], 1)
    with rasterio.open(paths[1]) as file:
        np.testing.assert_array_equal(file.read(1)[:, :half], whole[:, half:])


def test_files_of_points_are_compared(tmp_path, monkeypatch, capfd):
    run_script(monkeypatch, cloud_files, "--million", 0.004, "-o", tmp_path)
    rows = printed_table(capfd.readouterr().out)
    assert [row["file"] for row in rows] == ["`cloud.laz`", "`cloud.copc.laz`"]
    for row in rows:
        assert float(row["s"]) >= 0
        assert 30 < float(row["MB of memory"]) < 2000
        assert 1 < float(row["bytes per point"]) < 41
    one, other = (laspy.read(tmp_path / name).points.array for name in ("cloud.laz", "cloud.copc.laz"))
    assert sorted(point.tobytes() for point in one) == sorted(point.tobytes() for point in other)


def test_growth_is_measured_and_kept(tmp_path, monkeypatch, capfd):
    table = tmp_path / "growth.csv"
    table.write_text("what,million\narea,1\nviews,2\n")
    asked = ["--million", 0.012, "--period", PERIOD_PX, "--workers", 1, "--table", table, "--scratch", tmp_path]
    run_script(monkeypatch, large, "views", "--images", 3, *asked)
    (row,) = printed_table(capfd.readouterr().out)
    # Rows of another kind stay, those of this kind are replaced.
    with table.open(newline="") as file:
        other, found = csv.DictReader(file)
    assert (other["what"], found["what"]) == ("area", "views")
    assert (row["images"], row["workers"], row["tiles"]) == ("3", "1", "1") == (
        found["n_views"], found["workers"], found["n_tiles"])  # fmt: skip
    # Views look aside, so that some of them see more than the nadir does.
    assert 0.012 < float(found["million"]) < 0.06
    wall = [float(found[f"{stage}_s"]) for stage in ("orient", "match", "products")]
    assert 0 < sum(wall) < float(found["wall_s"])
    assert 0 < float(found["match_cpu_s"]) < float(found["cpu_s"])
    assert 100 < float(found["worker_mb"]) < 4000
    assert 100 < float(found["command_mb"]) < 4000
    assert 0.5 < float(found["filled"]) <= 1
    assert not list(tmp_path.glob("large-*"))


def test_kept_growth_is_drawn(tmp_path, monkeypatch):
    """That of the documents, from the table beside the script."""
    run_script(monkeypatch, large, "draw", "--picture", tmp_path / "growth.png")
    assert (tmp_path / "growth.png").stat().st_size > 10_000
    (tmp_path / "growth.csv").write_text(large.KEPT.read_text().replace("\nblock,", "\nviews,"))
    with pytest.raises(CannotRun, match=f"`{tmp_path}/growth.csv` has no rows of `block`: measure them first"):
        run_script(monkeypatch, large, "draw", "--picture", tmp_path / "x.png", "--table", tmp_path / "growth.csv")


def growth_of(million, workers) -> large.Growth:
    """Of a program that takes 10 s of CPU a million cells, 8 s of them to match; two workers are 1.5 times as fast."""
    wall = 10 * million / (1.5 if workers == 2 else 1)
    return large.Growth(million, 6, workers, 1, wall, 1.0, wall / 2, 1.0, 8 * million, 10 * million, 1500.0, 500.0, 1)


def test_growth_of_the_acceptance_table(tmp_path, monkeypatch):
    """Ratios of what was measured, on images as large as was asked for."""
    sides = []

    def measured(images, out, workers, memory_gb):
        sides.append((len(images), images[0], workers))
        return growth_of(images[0] ** 2 / 1e6, workers)

    monkeypatch.setattr(large, "write_views", lambda folder, town, n_views, side: n_views * [side])
    monkeypatch.setattr(large, "measured", measured)
    at = Workplace(None, tmp_path / "growth")
    figures = {figure.what: figure for figure in large_areas.growth(at, 0.01, 0.04, PERIOD_PX)}
    assert sides == [(6, 100, 1), (6, 100, 2), (6, 200, 1), (6, 200, 2)]
    assert figures["million cells"].value == 0.04
    assert figures["CPU per cell over that of 0.01 M"].value == pytest.approx(1)
    assert figures["worker's memory"].value == 1.5
    assert figures["two workers over one"].value == pytest.approx(1.5)
    assert figures["two workers over one"].cells()[3] == "SHORT"


def test_what_a_wider_halo_changes(small_town, tmp_path):
    """Few cells of a town in four tiles; and a cell counts where it differs by more than half a step or is empty."""
    at = Workplace(None, tmp_path / "halo")
    (figure,) = large_areas.changes(at, rendered_images(small_town, ("n1", "f1")), 64, {"twice": 64})
    assert figure.what == "tiles of 64, changed by a halo twice as wide"
    assert figure.at_most == large_areas.MAX_CHANGED
    assert 0 <= figure.value < 0.03
    n_tiles = [event for event in (tmp_path / "halo" / "halo32" / "events.jsonl").read_text().splitlines()
               if json.loads(event)["event"] == "tile"]  # fmt: skip
    assert len(n_tiles) >= 4
    one = np.array([1.0, 2.0, np.nan, np.nan, 5.0])
    assert large_areas.changed(one, one + np.array([0.0, 0.2, 0.0, 0.0, 0.3]), step_m=0.5) == 0.2
    assert large_areas.changed(one, np.array([1.0, 2.0, np.nan, 4.0, np.nan]), step_m=0.5) == 0.4


def test_rates_of_a_core_are_measured():
    found = machine.measured(runs=2)
    for name, rate in [(name, value) for name, value in vars(found).items() if name != "reads"] + [
        *found.reads.items()
    ]:
        assert LEAST_RATE < rate < MOST_RATE, name
    # Memory is slower than the caches, and a root than an addition.
    assert found.reads[machine.IN_MEMORY] < found.reads[machine.IN_L1]
    assert found.roots < found.arithmetic
    slower = replace(found, loads=found.loads / 2, reads={size: rate * 2 for size, rate in found.reads.items()})
    best = found.or_better(slower)
    assert best.loads == found.loads
    assert best.reads == slower.reads
    assert found.bandwidth(machine.IN_L2 + 1) == found.reads[machine.IN_L2]


def test_the_loops_that_measure_a_core_do_their_work():
    """Values that the loops write, against NumPy: what is not computed would be measured as fast."""
    a, out = np.linspace(0.5, 1.5, 40, dtype=np.float32), np.empty(40, np.float32)
    machine.multiply_add(a, np.float32(0.9), np.float32(0.1), 2, out)
    p, q, r, s = ((a * x + y) * u + v for x, y, u, v in
                  ((0.9, 0.1, 0.9, 0.1), (0.1, 0.9, 0.1, 0.9), (0.9, 0.9, 0.1, 0.1), (0.1, 0.1, 0.9, 0.9)))  # fmt: skip
    np.testing.assert_allclose(out, p * q + r * s, rtol=1e-6)
    machine.inverse_roots(a, 1, out)
    np.testing.assert_allclose(out, a**-0.5, rtol=1e-6)
    short = np.arange(32, dtype=np.uint16)
    total = short.copy()
    machine.added(short, total, 3)
    np.testing.assert_array_equal(total, 4 * short)
    assert machine.greatest(short, short + np.uint16(7), short, short, 1) == 38


PLAIN = machine.Machine(
    arithmetic=2.0, narrow=4.0, roots=0.5, gathers=1.0, loads=8.0, stores=4.0,
    reads={machine.IN_L1: 16.0, machine.IN_L2: 8.0, machine.IN_L3: 4.0, machine.IN_MEMORY: 2.0},
)  # fmt: skip


def test_bounds_follow_from_counts():
    """By hand, on a made-up machine: 6 / 2 + 8 / 4 operations, 1 root at 0.5, and so on."""
    count = roofline_counts.Count(ops=6, narrow=8, roots=1, gathers=3, loads=16, stores=2, memory=4)
    bounds = count.bounds_ns(PLAIN, machine.IN_MEMORY)
    assert bounds == {"operations": 5.0, "roots": 2.0, "gathers": 3.0, "loads": 2.0, "stores": 0.5, "memory": 2.0}
    assert (count * 2 + count).bounds_ns(PLAIN, machine.IN_L1)["memory"] == 12 / 16
    # More views are more pairs a view, and a larger window is more work.
    three, six = (roofline_counts.costs(n, [1, 2], 32).ops for n in (3, 6))
    assert three < six < roofline_counts.costs(6, [1, 3], 32).ops


@pytest.fixture
def a_pair(small_town, tmp_path) -> Path:
    """The small town with two of its images, for what is run several times."""
    folder = tmp_path / "pair"
    folder.mkdir()
    for name in ("img_n1.tif", "img_f1.tif", "truth_dsm.tif"):
        (folder / name).symlink_to(small_town / name)
    return folder


@pytest.mark.skipif(
    tuple(map(int, numba.__version__.split(".")[:2])) < (0, 62),
    reason="operations are counted in machine code of LLVM 20, which Numba has since 0.62: older code is slower",
)
def test_the_roofline_of_a_kernel_and_of_the_program(a_pair, monkeypatch, capsys):
    """No kernel reaches its bound; two threads get at most twice as much; stages add up."""
    asked = ["--kernels", "smooth", "--seconds", 0.05, "--rates", 2, "--program", a_pair, "--rounds", 1]
    assert run_script(monkeypatch, roofline, *asked) == 0
    printed = capsys.readouterr().out
    rates, kernels, both, stages = (printed_table(printed, number) for number in range(4))
    assert len(rates) == 6
    (kernel,) = kernels
    assert (kernel["kernel"], kernel["unit"]) == ("smooth_surface", "cell")
    bound, reached = float(kernel["bound, ns"].split()[0]), float(kernel["reached, ns"])
    assert 0 < bound < reached
    assert share_of(kernel["share"]) == pytest.approx(bound / reached, abs=0.05)
    (threaded,) = both
    # Of a machine that does other work little can be said, but never more than two threads can do.
    assert 0 < float(threaded["CPU per wall"]) < 2.2
    names = [row["stage"] for row in stages]
    assert {"open", "orient", "setup", "match"} < set(names)
    assert names[-1] == "all, with start and imports"
    for column in ("CPU", "wall, 1 worker"):
        *parts, whole = (float(row[column]) for row in stages)
        assert sum(parts) < whole + 0.05 * len(parts)  # each is rounded
    assert f"Bar: {threads.BAR}." in printed


def test_a_wrong_count_fails(monkeypatch, capsys):
    """A kernel that is said to do more than can be done in its time."""
    (smooth,) = (kernel for kernel in roofline.KERNELS if kernel.name == "smooth_surface")
    monkeypatch.setattr(roofline, "KERNELS", (replace(smooth, count=smooth.count * 100),))
    monkeypatch.setattr(roofline, "measured", lambda runs: PLAIN)
    assert run_script(monkeypatch, roofline, "--no-threads", "--seconds", 0.01) == 1
    assert "its count is wrong" in capsys.readouterr().err


def test_two_threads_do_the_work_twice():
    """Each case in a thread of its own, as often as asked for; their CPU is that of a thread."""
    calls = []
    cases = [bench_kernels.Case(lambda name=name: calls.append(name), 1, "call") for name in "ab"]
    found = threads.run_together(cases, 3)
    assert sorted(calls) == ["a", "a", "a", "b", "b", "b"]
    assert 0 <= found.cpu_s <= found.wall_s + 0.05

    def burn():
        start = time.thread_time()
        while time.thread_time() < start + 0.05:
            pass

    assert threads.run_together([bench_kernels.Case(burn, 1, "call")], 1).cpu_s > 0.04


def test_the_time_of_a_small_pair_is_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(resources, "N_SMALL_RUNS", 1)
    monkeypatch.setattr(resources, "SMALL_SIDE_CELLS", 96)
    figures = {figure.what: figure for figure in resources.start_up(Workplace(None, tmp_path))}
    assert figures["time from start to end, one core"].at_most == 1.5
    assert figures["time from start to end, one core"].value > 0.9 * figures["CPU"].value > 0.5
    assert 100**2 < figures["pixels per image"].value < 200**2
    assert (tmp_path / "dsm" / "report.html").exists()


def test_the_benchmarks_of_the_kernels(tmp_path, monkeypatch):
    """All of them on scenes of 64 cells, by the row of the acceptance table; speeds mean nothing there."""
    # Where these tests run in several processes, pytest-benchmark would believe that the benchmarks do so too.
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    figures = {figure.what: figure for figure in resources.kernels(Workplace(None, tmp_path), side=64)}
    report = json.loads((tmp_path / "benchmarks.json").read_text())
    names = {benchmark["name"].split("[")[0] for benchmark in report["benchmarks"]}
    assert names == {
        "test_resample", "test_costs", "test_costs_of_evidence", "test_costs_of_candidates",
        "test_sgm", "test_mgm", "test_winners", "test_least_costs", "test_profile",
        "test_smooth", "test_local_planes", "test_weighted_medians",
        "test_visibility", "test_free_rays", "test_ray_costs", "test_agreement",
        "test_shade", "test_reach", "test_spline", "test_ortho",
        "test_image_from_ground", "test_ground_from_image", "test_to_the_earth",
        "test_rpc_image_from_ground", "test_rpc_ground_from_image", "test_ideal_positions", "test_nearest_descriptors",
    }  # fmt: skip
    for benchmark in report["benchmarks"]:
        (ns,) = (value for name, value in benchmark["extra_info"].items() if name.startswith("ns per"))
        (per_s,) = (value for name, value in benchmark["extra_info"].items() if name.endswith(" per s"))
        assert ns * per_s == pytest.approx(1e9)
        assert 0.02 < ns < 20_000, benchmark["name"]
        assert benchmark["extra_info"]["threads"] == 1
    barred = [what for what, figure in figures.items() if figure.bar]
    assert barred == ["SGM, 8 paths", "over OpenCV StereoSGBM HH", "resample + NCC 7 x 7"]
    # Beside them, the speed of OpenCV and the time of each benchmark.
    assert len(figures) == len(barred) + 1 + len(report["benchmarks"])
    assert figures["SGM, 8 paths"].unit == "M cell-steps/s"
    assert figures["SGM, 8 paths"].value > 5


def test_a_kernel_of_the_benchmarks_finds_what_it_should():
    """Their made-up scenes are such that kernels have work: costs of all heights, and least sums that differ."""
    case = bench_kernels.costs_case(2, [1], 0.0, side=64)
    assert (case.n, case.unit) == (64 * 64 * 32 * 2, "cell, step and image")
    heights = bench_kernels.lattice(64, None)
    assert heights.count.min() >= 16
    assert heights.count.max() <= 64
    town = bench_kernels.city_lattice(576)
    assert 22 < town.count.mean() < 28  # as the page says
    assert np.median(town.count) == 16


def test_clicks_on_a_surface_are_timed(small_surface, monkeypatch, capsys):
    run_script(monkeypatch, inspecting, small_surface, "--clicks", 4, "--tiles", 6, "--bar-ms", 60_000)
    rows = dict(line.split("  ", 1) for line in capsys.readouterr().out.splitlines())
    assert list(rows)[:5] == [
        "million cells", "a click answered, median", "a click answered, slowest of 4",
        "a tile of the map, median", "a tile of the map, slowest of 6",
    ]  # fmt: skip
    assert float(rows["million cells"]) == pytest.approx(112**2 / 1e6, abs=1e-5)
    median, slowest = (rows[name].split() for name in ("a click answered, median", "a click answered, slowest of 4"))
    assert 0 < float(median[0]) <= float(slowest[0])
    assert median[1:] == ["ms", "<=", "60000", "ms", "pass"]


def test_clicks_are_at_cells_with_a_height(small_surface):
    with rasterio.open(small_surface / "dsm.tif") as file:
        heights, to_cell = file.read(1), ~file.transform
    for x, y in inspecting.places(small_surface, 20):
        col, row = to_cell * (x, y)
        assert np.isfinite(heights[int(row), int(col)])
