"""Rows of the acceptance table on speed, memory and interruption, and on a fresh clone."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import rasterio

from rows.rendered import VIEWS, town_figures
from workplace import ROOT, ZLOCUS, CannotRun, Figure, Usage, Workplace, render, rendered_images, run

# Runs a program on one core.
ON_ONE_CORE = """
import os, sys
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
os.execv(sys.argv[1], sys.argv[1:])
"""
LARGE_SIDE_CELLS = 4000
# A town of more than 4 million cells of 0.5 m, and the CPU seconds per million cells that it may take.
SPEED_SIDE_CELLS, SPEED_SEED = 2048, 12
SPEED_BARS_S = {"six": 8.0, "three": 4.0}
# Cells along a side of a town whose images have about 300 x 300 pixels, and how often its surface is made.
SMALL_SIDE_CELLS, N_SMALL_RUNS = 280, 9
# Bounds of the peak memory of a run as a share of what it had planned.
LEAST_BY_PLAN, MOST_BY_PLAN = 0.75, 1.25
# Signals in the row `signals`; the tests send fewer of them.
N_SIGNALS = 30


def kernels(workplace: Workplace, side: int | None = None) -> list[Figure]:
    """Speed of the kernels, from the `extra_info` of their benchmarks.

    side : cells along a side of the benchmarks' scenes, None for the usual number.
    """
    report = workplace.out / "benchmarks.json"
    workplace.out.mkdir(parents=True, exist_ok=True)
    options = ["--benchmark-enable", "--benchmark-only", f"--benchmark-json={report}"]
    options += [] if side is None else ["--side", str(side)]
    run([sys.executable, "-m", "pytest", ROOT / "benchmarks", *options], cwd=ROOT)
    found: dict[str, float] = {}
    each = []
    for benchmark in json.loads(report.read_text())["benchmarks"]:
        found |= benchmark["extra_info"]
        each += kernel_figures(benchmark["name"].removeprefix("test_"), benchmark["extra_info"])
    try:
        sgm, opencv = found["sgm_cell_steps_per_s"], found["opencv_hh_cell_steps_per_s"]
        ncc = found["resample_ncc_ns"]
    except KeyError as missing:
        raise CannotRun(f"no benchmark gives {missing} in its extra_info") from missing
    return [
        Figure(
            "SGM, 8 paths", sgm / 1e6, "M cell-steps/s", at_least=200,
            fails_when="the aggregation loses its vector instructions, or path costs become 32 bits wide",
        ),
        Figure(
            "over OpenCV StereoSGBM HH", sgm / opencv, at_least=1.3, fails_when="the aggregation becomes slower",
        ),
        Figure(
            "resample + NCC 7 x 7", ncc, "ns", at_most=6,
            fails_when="resampling or window sums take more passes, or an array leaves the cache",
        ),
        Figure("OpenCV StereoSGBM HH", opencv / 1e6, "M cell-steps/s", is_detail=True),
        *each,
    ]  # fmt: skip


def kernel_figures(name: str, found: dict[str, Any]) -> list[Figure]:
    """Time of a unit of work of one benchmark of a `bench_*.py`; labels name both."""
    times = [key for key in found if key.startswith("ns per ")]
    return [Figure(f"{name}, per {key.removeprefix('ns per ')}", found[key], "ns", is_detail=True) for key in times]


def memory(workplace: Workplace) -> list[Figure]:
    """CPU and memory of a run on six rendered views of a large area."""
    scene = workplace.out / "scene"
    render(scene, "city", LARGE_SIDE_CELLS)
    with rasterio.open(scene / "truth_dsm.tif") as truth:
        crs, bounds = truth.crs.to_string(), tuple(truth.bounds)
    images, out = rendered_images(scene), workplace.out / "dsm"
    run([ZLOCUS, "dsm", *images, "-o", out, "--resolution", 0.5, "--crs", crs, "--bounds", *bounds])
    return of_all_processes(json.loads((out / "run.json").read_text()), at_most_gb=3)


def of_all_processes(record: dict[str, Any], at_most_gb: float | None = None) -> list[Figure]:
    """CPU of a run with its workers, and the largest memory of one process, from run.json.

    Workers are not children of the command, so the usage that the system reports for the command leaves them out.
    """
    stages = record["stages"]
    return [
        Figure("CPU", sum(stage["cpu_s"] for stage in stages), "s"),
        Figure(
            "peak memory of a process", max(stage["peak_mb"] for stage in stages) / 1e3, "GB", at_most=at_most_gb,
            fails_when="a stage holds whole images or rasters instead of tiles",
        ),
    ]  # fmt: skip


def _is_peak_its_own(record: dict[str, Any]) -> bool:
    """Whether the process of a run reached its largest memory after the first stage of the run."""
    peaks = [stage["peak_mb"] for stage in record["stages"]]
    return bool(peaks[0] < max(peaks))


def peaks_by_plan(folder: Path) -> list[Figure]:
    """The largest memory of a process divided by what its run had planned: least and largest of the runs in a folder.

    Runs of the cluster are not counted, nor those of other programs and earlier versions, whose records hold no plan,
    nor a run in a process that needed as much memory for an earlier run: its own peak is not known.
    """
    records = [json.loads(path.read_text()) for path in sorted(folder.rglob("run.json"))]
    shares = [
        max(stage["peak_mb"] for stage in record["stages"]) / record["plan"]["process_mb"]
        for record in records
        if "plan" in record and not record["config"]["request"].get("scheduler") and _is_peak_its_own(record)
    ]
    if not shares:
        return []
    why = "arrays are made that the plan does not count, or kept longer than needed"
    return [
        Figure(
            "peak memory by its plan, least",
            min(shares),
            at_least=LEAST_BY_PLAN,
            fails_when="a plan counts memory that no tile takes",
        ),
        Figure("peak memory by its plan, largest", max(shares), at_most=MOST_BY_PLAN, fails_when=why),
    ]


def speed(workplace: Workplace) -> list[Figure]:
    """CPU of the whole program on a large town with one worker and cached kernels, and the accuracy of the surface."""
    scene, small, figures = workplace.out / "scene", workplace.scene("rendered-city"), []
    render(scene, "city", SPEED_SIDE_CELLS, "--seed", SPEED_SEED)
    with rasterio.open(scene / "truth_dsm.tif") as truth:
        crs, bounds = truth.crs.to_string(), tuple(truth.bounds)
    area = ["--resolution", 0.5, "--crs", crs, "--bounds", *bounds, "--workers", 1]
    million_cells = (bounds[2] - bounds[0]) * (bounds[3] - bounds[1]) / 0.5**2 / 1e6
    run([ZLOCUS, "dsm", *rendered_images(small), "-o", workplace.out / "compiled", "--resolution", 0.5, "--overwrite"])
    for name, bar in SPEED_BARS_S.items():
        out, images = workplace.out / name, rendered_images(scene, VIEWS[name])
        used = run([ZLOCUS, "dsm", *images, "-o", out, *area, "--overwrite"])
        per_million = used.cpu_s / million_cells
        figures.append(
            Figure(
                f"{name}, CPU per million cells", per_million, "s", at_most=bar,
                fails_when="a kernel or a stage becomes slower, or more heights are searched",
            )
        )  # fmt: skip
        figures += town_figures(name, workplace.judge(out / "dsm.tif", scene), {})
    return [Figure("million cells", million_cells), *figures]


def start_up(workplace: Workplace) -> list[Figure]:
    """Time of the whole program on a small pair with the usual options, on one core and with compiled kernels.

    The shortest of several runs counts: the others waited for other work of the machine.
    """
    scene, images = workplace.out / "scene", ("n1", "f1")
    render(scene, "city", SMALL_SIDE_CELLS)
    on_one_core = [sys.executable, "-c", ON_ONE_CORE, ZLOCUS]
    command = [*on_one_core, "dsm", *rendered_images(scene, images), "-o", workplace.out / "dsm", "--overwrite"]
    runs = [run(command) for _ in range(N_SMALL_RUNS + 1)][1:]
    with rasterio.open(rendered_images(scene, images)[0]) as image:
        pixels = image.width * image.height
    return [
        Figure(
            "time from start to end, one core", min(used.wall_s for used in runs), "s", at_most=1.5,
            fails_when="modules are imported, or kernels are read, that a usual run does not need",
        ),
        Figure("CPU", min(used.cpu_s for used in runs), "s"),
        Figure("pixels per image", pixels),
    ]  # fmt: skip


def signals(workplace: Workplace) -> list[Figure]:
    """The test that interrupts a run by signals at random moments and resumes it, with more signals than usual.

    The exit status of the test is the figure: 1 where a resumed run differs from one that was never interrupted.
    """
    test = "tests/runs/test_resume.py::test_signals_at_random_moments"
    command = ["env", f"ZLOCUS_SIGNALS={N_SIGNALS}", sys.executable, "-m", "pytest", "-q", test]
    status, used = status_of(command, ROOT)
    workplace.inputs["signals"] = N_SIGNALS
    return [
        Figure(
            f"exit status of the test with {N_SIGNALS} signals", status, at_most=0,
            fails_when="a signal costs a finished tile, leaves a process or a file behind, or changes a byte",
        ),
        Figure("CPU", used.cpu_s, "s"),
    ]  # fmt: skip


def clone(workplace: Workplace) -> list[Figure]:
    """A fresh clone, with nothing but Python and make: `make demo` and `make test`."""
    folder = workplace.out / "zlocus"
    run(["git", "clone", "--quiet", ROOT, folder])
    figures = []
    for target in ("demo", "test"):
        status, used = status_of(["make", target, f"PYTHON={sys.base_prefix}/bin/python3"], folder)
        figures.append(
            Figure(
                f"exit status of make {target}", status, at_most=0,
                fails_when="a file is not committed, or a package cannot be installed as a wheel",
            )
        )  # fmt: skip
        figures.append(Figure(f"CPU of make {target}", used.cpu_s, "s"))
    return figures


def status_of(command: list[Any], folder: Path) -> tuple[int, Usage]:
    """Whether a command fails (1) or not (0), and what it uses. folder : in which it runs."""
    failures = tuple(range(1, 256))
    used = run(command, accept=(0, *failures), cwd=folder)
    return int(used.status != 0), used
