"""Kernels are made when they are called, and read from disk without Numba's compiler."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from zlocus.core.jit import kernel
from zlocus.core.lazy_kernels import LazyKernel

MODULE = """
import numpy as np
from zlocus.core.jit import kernel

@kernel
def lowest(values):
    if not len(values):
        raise ValueError("no values")
    return values[np.argmin(values)] if np.isfinite(values).all() else np.nan

@kernel
def twice_lowest(values):
    return 2.0 * lowest(values)

@kernel
def nowhere_kept(values):
    return 3.0 * twice_lowest(values) + lowest(values)
"""
# Parts of Numba's compiler that the compiler itself imports when it begins.
COMPILER = {"numba.np.arraymath", "numba.cpython.charseq"}
CALL = f"""
import os, sys
from zlocus.core import lazy_kernels
if "CHANGED" in os.environ:
    lazy_kernels.KeptLibrary.of = None
import numpy as np
import loops
names = sys.argv[1].split()
print(*(getattr(loops, name)(np.array([3.0, 1.0, 2.0])) for name in names))
print(*(name for name, made in vars(loops).items() if "dispatcher" in getattr(made, "__dict__", {{}})))
print(sum(sum(getattr(loops, name).stats.cache_hits.values()) for name in names))
print(*sorted({COMPILER} & set(sys.modules)))
try:
    loops.lowest(np.zeros(0))
except ValueError as error:
    print(error)
"""


@kernel
def double(value):
    return value + value


def called(folder, *names, **more):
    """Lines that a process writes which calls kernels of the module: their results, those with a dispatcher, how many
    were read from disk, parts of the compiler, and an error that a kernel raises. more : environment variables."""
    if not (folder / "loops.py").exists():
        (folder / "loops.py").write_text(MODULE)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "kept"), "PYTHONPATH": str(folder)} | more
    done = subprocess.run(
        [sys.executable, "-c", CALL, " ".join(names)], env=environment, capture_output=True, text=True, check=False
    )
    assert not done.returncode, done.stderr
    return done.stdout.splitlines()


def test_kept_kernels_are_read_without_the_compiler(tmp_path):
    compiled = called(tmp_path, "lowest", "twice_lowest")
    assert compiled[0] == "1.0 2.0"
    assert compiled[2:4] == ["0", " ".join(sorted(COMPILER))]
    assert called(tmp_path, "lowest", "twice_lowest") == ["1.0 2.0", "lowest twice_lowest", "2", "", "no values"]


def test_a_numba_that_has_changed_inside_reads_kernels_in_its_own_way(tmp_path):
    compiled = called(tmp_path, "lowest", "twice_lowest")
    assert called(tmp_path, "lowest", "twice_lowest", CHANGED="yes")[:3] == [*compiled[:2], "2"]


def test_a_kernel_inside_another_has_no_dispatcher(tmp_path):
    called(tmp_path, "lowest", "twice_lowest")
    assert called(tmp_path, "twice_lowest")[1] == "twice_lowest"


def test_a_new_kernel_takes_in_kernels_that_were_read(tmp_path):
    """Their second form, from which the compiler takes code, is read then."""
    called(tmp_path, "lowest", "twice_lowest")
    mixed = called(tmp_path, "lowest", "twice_lowest", "nowhere_kept")
    assert mixed[0] == "1.0 2.0 7.0"
    assert mixed[2] == "2"
    assert mixed[4] == "no values"
    assert called(tmp_path, "nowhere_kept", "lowest")[:3] == ["7.0 1.0", "lowest nowhere_kept", "2"]


def test_a_dispatcher_is_made_once_by_whichever_thread_comes_first():
    made = []

    def slowly(function):
        made.append(function)
        return lambda value: function(value)

    lazy = LazyKernel(lambda value: value + 1, slowly)
    assert not made
    with ThreadPoolExecutor(8) as threads:
        assert list(threads.map(lazy, range(64))) == list(range(1, 65))
    assert len(made) == 1


def test_a_kernel_is_pickled_by_name():
    assert pickle.loads(pickle.dumps(double)) is double
    assert double(np.float32(4.0)) == 8.0


def test_protocols_of_other_libraries_make_no_dispatcher():
    lazy = LazyKernel(lambda value: value, lambda function: pytest.fail("a dispatcher is made"))
    assert not hasattr(lazy, "__array_interface__")
    assert lazy.py_func(3) == 3
