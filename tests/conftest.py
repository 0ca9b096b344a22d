"""What every test shares: the data folder, and runs that repeat exactly."""

from __future__ import annotations

import gc
import os
from pathlib import Path

# One thread per test process, set before Numba and NumPy read it. The command line does the same for linear algebra,
# whose threads wait for each other in vain where another process has the core.
os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# No test depends on the rates that earlier runs of this machine have left, or leaves some.
os.environ["ZLOCUS_RATES"] = ""
# Hundreds of processes import the package: where its bytecode is not kept, each of them compiles it for half a second.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import pytest
from hypothesis import settings

TESTS = Path(__file__).parent
# What `make test-fast` leaves out (marker `slow`): whole runs, pages, and files that take more than some ten seconds.
SLOW = (
    "runs", "docs", "benchmarks", "installation", "pipeline", "inspector", "products/report", "cli",
    "core/test_resources.py", "core/test_signals.py", "core/test_startup.py", "core/test_startup_imports.py",
    "evaluation/test_evaluate_coarse_references.py", "io/test_io_damaged_files.py", "io/test_open_raster_remote.py",
    "matching/test_fusion.py", "matching/test_true_ortho.py", "orientation/test_parameter_groups.py",
    "orientation/test_self_calibration.py", "synthetic/test_drone_block.py", "synthetic/test_linescan.py",
    "test_api.py",
)  # fmt: skip

settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=50, database=None)
settings.load_profile("repeatable")


def pytest_configure(config):
    config.addinivalue_line("markers", "slow: left out of `make test-fast`; set by the table in tests/conftest.py")


def pytest_sessionstart(session):
    """Compile the kernels once, before several processes would each compile the same ones at the same time."""
    if session.config.getoption("numprocesses", None) and not hasattr(session.config, "workerinput"):
        from dataclasses import replace
        from tempfile import TemporaryDirectory

        from zlocus.pipeline.execution.precompile import kernels_compiling
        from zlocus.synthetic.files import render_scene
        from zlocus.synthetic.scenes import city_spec

        with kernels_compiling(), TemporaryDirectory() as folder:
            render_scene(replace(city_spec(16), size=32), Path(folder) / "scene")


def pytest_collection_finish():
    """Let Python's collector of unused objects leave out the thousands of tests, and look at the others as rarely as
    `precompile` does: kernels that are compiled in tests make millions of objects."""
    gc.freeze()
    gc.set_threshold(20_000, 10, 10)


def pytest_collection_modifyitems(items):
    slow = [TESTS / name for name in SLOW]
    for item in items:
        if any(item.path.is_relative_to(place) for place in slow):
            item.add_marker(pytest.mark.slow)
    items[:] = in_halves(items)


def in_halves(items):
    """The tests in two halves, which the two processes of `make test` begin with: every other slow file first, with all
    its tests, then half of the other tests. A process that has nothing left takes tests from the end of the other's,
    and short ones let both end at the same time."""
    files = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    slow = [tests for tests in files.values() if tests[0].get_closest_marker("slow")]
    quick = [item for tests in files.values() if not tests[0].get_closest_marker("slow") for item in tests]
    first, second = ([item for tests in slow[at::2] for item in tests] for at in (0, 1))
    # So that the halves have equal numbers of tests, as pytest-xdist deals them out.
    n = min(max(len(items) // 2 - len(first), 0), len(quick))
    return [*first, *quick[:n], *second, *quick[n:]]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real and rendered scenes, from ZLOCUS_TEST_DATA; the test is skipped without it."""
    folder = os.environ.get("ZLOCUS_TEST_DATA")
    if not folder:
        pytest.skip("ZLOCUS_TEST_DATA is not set: no shared scenes to test on")
    path = Path(folder)
    if not path.is_dir():
        pytest.fail(f"ZLOCUS_TEST_DATA is {folder}, which is not a folder")
    return path


@pytest.fixture(scope="session")
def small_town(tmp_path_factory) -> Path:
    """Folder of a rendered town of 56 m with ground, roofs and trees, its exact truth, and all eight views."""
    from dataclasses import replace

    from zlocus.synthetic.files import render_scene
    from zlocus.synthetic.scenes import city_spec

    folder = tmp_path_factory.mktemp("town") / "small-town"
    render_scene(replace(city_spec(16), size=112), folder)
    return folder


@pytest.fixture(scope="session")
def small_surface(small_town, tmp_path_factory) -> Path:
    """Folder of the surface of `small_town`, from its six views of one date, on 0.5 m cells of the truth's area. Its
    ortho-image keeps the grey values of the images."""
    import io

    import rasterio

    from zlocus.core.options import ProductOptions, RunConfig
    from zlocus.core.progress import progress_for
    from zlocus.core.requests import DsmRequest
    from zlocus.pipeline.dsm import run_dsm

    out = tmp_path_factory.mktemp("town") / "surface"
    with rasterio.open(small_town / "truth_dsm.tif") as truth:
        area = {"crs": truth.crs.to_string(), "bounds": tuple(truth.bounds), "resolution": 0.5}
    images = tuple(small_town / f"img_{view}.tif" for view in ("n1", "f1", "b1", "n2", "f2", "b2"))
    config = RunConfig(products=ProductOptions(ortho_levels="own"))
    run_dsm(DsmRequest(inputs=images, out=out, report=False, **area), config, progress_for(io.StringIO()))
    return out


@pytest.fixture(scope="session")
def images(tmp_path_factory):
    """Images of an analytic ground, rendered once: `images(kind)`."""
    from rendered_scenes import rendered

    made = {}

    def of(kind):
        if kind not in made:
            made[kind] = rendered(tmp_path_factory.mktemp(kind), kind)
        return made[kind]

    return of


@pytest.fixture(scope="session")
def good_pair(tmp_path_factory):
    """Paths of two images that match, for commands whose other inputs are bad."""
    from rendered_scenes import rendered

    images = rendered(tmp_path_factory.mktemp("good"), "plane")
    return images.paths["nadir"], images.paths["fore"]
