"""What a command does without."""

import subprocess
import sys

import pytest

PREPARED = """
import gc, sys
from zlocus.core import startup
startup.prepare()
import zlocus.pipeline.dsm, pyogrio.raw
is_rare = gc.get_threshold()[0] == startup.OBJECTS_PER_COLLECTION
print(gc.isenabled(), is_rare, sys.modules["pandas"], sys.modules["dask"])
heavy = {"matplotlib", "scipy.ndimage", "zlocus.pipeline.report_inputs", "zlocus.evaluation.evaluate"}
print(*sorted(heavy & set(sys.modules)))
"""
COMMAND = """
import gc, sys
from zlocus.cli import app as cli
from zlocus.core import startup
try:
    cli.main(["config"])
except SystemExit:
    print(gc.get_threshold()[0] == startup.OBJECTS_PER_COLLECTION, sys.modules.get("pandas", "there"), file=sys.stderr)
"""
LIBRARY = """
import gc, sys
was = gc.get_threshold()
import zlocus.api, zlocus.cli.app, zlocus.pipeline.dsm
print(gc.get_threshold() == was, "pandas" in sys.modules, sys.modules.get("dask", "nothing") is None)
"""
# What `zlocus dsm` of satellite images with the usual options has no use for: parts of SciPy and of Numba's compiler,
# other libraries, and modules for other kinds of runs.
UNNEEDED = (
    "scipy.linalg", "scipy.ndimage", "scipy.sparse", "scipy.spatial", "scipy.special", "numba.np.arraymath",
    "numba.cpython.charseq", "asyncio", "matplotlib", "multiprocessing", "pystac", "unittest.mock", "urllib3",
    "zlocus.evaluation.evaluate", "zlocus.matching.fusion", "zlocus.matching.image_space",
    "zlocus.matching.selected_surface", "zlocus.matching.stereo_selection", "zlocus.orientation.bundle_adjustment",
    "zlocus.orientation.determinability", "zlocus.orientation.self_calibration", "zlocus.pipeline.cloud",
    "zlocus.pipeline.execution.cluster", "zlocus.pipeline.execution.processes", "zlocus.pipeline.image_scenes",
    "zlocus.pipeline.image_tiles",
)  # fmt: skip
SURFACE = """
import sys
from zlocus.cli import app as cli
try:
    cli.main(["dsm", *sys.argv[2:], "--workers", "1"])
except SystemExit as end:
    kernels = [made for name, module in list(sys.modules.items()) if name.startswith("zlocus") and "kernel" in name
               for made in vars(module).values() if type(made).__name__ == "LazyKernel"]
    dispatchers = [made.py_func for made in kernels if "dispatcher" in vars(made)]
    print(end.code, *(name for name in sys.argv[1].split() if name in sys.modules))
    print(len(set(made.py_func for made in kernels)), len(set(dispatchers)))
"""
CLUSTER = """
from zlocus.core import startup
startup.prepare()
from zlocus.core.errors import ConfigError
from zlocus.pipeline.execution import cluster
cluster.CONNECT_S = 1.0
try:
    cluster.Cluster(print, "tcp://127.0.0.1:9")
except ConfigError as error:
    print(error)
"""


def said(code, *arguments):
    return subprocess.run([sys.executable, "-c", code, *arguments], check=True, capture_output=True, text=True)


def test_what_a_surface_takes_no_part_in_is_not_imported():
    """pyogrio does without pandas, odc-geo without dask; cycles are still looked for."""
    assert said(PREPARED).stdout.splitlines() == ["True True None None", ""]


def test_a_usual_surface_imports_and_loads_what_it_needs_only(good_pair, tmp_path):
    """With everything that a run writes by default, the report too, and with kernels that are compiled already."""
    inputs = [*map(str, good_pair), "-o", str(tmp_path / "out"), "--overwrite"]
    said(SURFACE, "", *inputs)
    *_, imported, kernels = said(SURFACE, " ".join(UNNEEDED), *inputs).stdout.splitlines()
    assert imported == "0"
    n_kernels, n_dispatchers = map(int, kernels.split())
    assert n_kernels > 200
    assert n_dispatchers <= 40
    assert (tmp_path / "out" / "report.html").stat().st_size > 100_000


def test_a_command_is_prepared():
    assert said(COMMAND).stderr.split() == ["True", "None"]


def test_the_package_as_a_library_leaves_the_process_alone():
    assert said(LIBRARY).stdout.split() == ["True", "False", "False"]


def test_a_command_finds_its_cluster():
    """Which needs dask."""
    pytest.importorskip("distributed")
    assert said(CLUSTER).stdout.startswith("--scheduler tcp://127.0.0.1:9 does not answer")
