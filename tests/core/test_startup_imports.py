"""Importing zlocus changes nothing in the process of somebody else."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import gc, os, pkgutil, signal, sys, warnings
import numba

def state():
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    blocked = sorted(name for name, module in sys.modules.items() if module is None)
    return dict(os.environ), handlers, blocked, gc.get_threshold(), numba.config.CACHE_DIR, warnings.showwarning

# Libraries may set up themselves; only the difference that zlocus makes counts.
import cv2, dask, distributed, matplotlib, odc.geo, pyogrio, rasterio, scipy.spatial, shapely, typer, xarray
before = state()
import zlocus
for module in pkgutil.walk_packages(zlocus.__path__, "zlocus."):
    if not module.name.endswith("__main__"):
        __import__(module.name)
assert state() == before, [(a, b) for a, b in zip(before, state()) if a != b]
"""


def test_importing_every_module_changes_nothing_in_the_process():
    run = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
