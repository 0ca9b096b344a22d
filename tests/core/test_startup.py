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
CLUSTER = """
from zlocus.core import startup
startup.prepare()
from zlocus.core.errors import ConfigError
from zlocus.pipeline.execution.cluster import Cluster
try:
    Cluster(print, "tcp://127.0.0.1:9")
except ConfigError as error:
    print(error)
"""


def said(code):
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)


def test_what_a_surface_takes_no_part_in_is_not_imported():
    """pyogrio does without pandas, odc-geo without dask; cycles are still looked for."""
    assert said(PREPARED).stdout.splitlines() == ["True True None None", ""]


def test_a_command_is_prepared():
    assert said(COMMAND).stderr.split() == ["True", "None"]


def test_the_package_as_a_library_leaves_the_process_alone():
    assert said(LIBRARY).stdout.split() == ["True", "False", "False"]


def test_a_command_finds_its_cluster():
    """Which needs dask."""
    pytest.importorskip("distributed")
    assert said(CLUSTER).stdout.startswith("--scheduler tcp://127.0.0.1:9 does not answer")
