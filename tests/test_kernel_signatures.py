"""The signature comment above each kernel: as many arguments as the function takes, and its result.

A record (`NamedTuple`) stands there with its name; the comments of its fields begin with their shapes and types.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
import sys

import pytest
from numba.core import types

import zlocus.matching.kernels
import zlocus.orientation.kernels


def all_kernels():
    """Every kernel by name, with the comment above its decorator."""
    found = {}
    packages = (zlocus.matching.kernels, zlocus.orientation.kernels)
    names = [f"{package.__name__}.{m.name}" for package in packages for m in pkgutil.iter_modules(package.__path__)]
    sensors = [f"sensors.{name}_kernel" for name in ("frame", "location_grid", "rpc", "straighten")]
    single = ["products.shade_kernel", *sensors]
    for name_of_module in [*names, *(f"zlocus.{name}" for name in single)]:
        loaded = importlib.import_module(name_of_module)
        source = inspect.getsource(loaded)
        for comment, name in re.findall(r"# (.*)\n@(?:parallel_)?kernel\ndef (\w+)\(", source):
            found[name] = (getattr(loaded, name), comment, loaded)
        assert len(re.findall(r"\n@(?:parallel_)?kernel\n", source)) == source.count("kernel\ndef "), name_of_module
    return found


KERNELS = all_kernels()


DTYPES = {"f4": types.float32, "f8": types.float64, "i2": types.int16, "i4": types.int32, "i8": types.int64,
          "u1": types.uint8, "u2": types.uint16, "u4": types.uint32, "u8": types.uint64, "c8": types.complex64,
          "b1": types.boolean}  # fmt: skip


PART = r"(?:\(([^)]*)\) )?(None|[fiubc]\d|[A-Z]\w+)"


def promised(comment, module):
    """Numba types of the arguments and of the result that a comment in a module names."""
    arguments, result = ([typed(*part, module) for part in re.findall(PART, side)] for side in comment.split(" -> "))
    return tuple(arguments), result[0]


def record(kind):
    """Numba type of a record: of each field the type with which its comment begins."""
    lines = dict(re.findall(r"\n    (\w+): [^#\n]*# (.*)", inspect.getsource(kind)))
    module = importlib.import_module(kind.__module__)
    fields = [typed(*re.match(PART, lines[name]).groups(), module) for name in kind._fields]
    return types.BaseTuple.from_types(fields, kind)


def typed(shape, kind, module):
    """(r,c) f4 is a two-dimensional array of float32, f4 a number, `Record` a record of that name."""
    if kind == "None":
        return types.none
    if kind not in DTYPES:
        kernel_modules = [m for name, m in sys.modules.items() if name.startswith("zlocus.matching.kernels.")]
        return record(next(getattr(m, kind) for m in (module, *kernel_modules) if hasattr(m, kind)))
    places = [place for place in (shape or "").split(",") if place]
    return types.Array(DTYPES[kind], len(places), "C") if places else DTYPES[kind]


def test_every_kernel_has_a_comment():
    assert len(KERNELS) >= 20
    odd = [name for name, (_, comment, _) in KERNELS.items() if " -> " not in comment and not comment.startswith("as ")]
    assert not odd


@pytest.mark.parametrize("name", [name for name in KERNELS if not KERNELS[name][1].startswith("as ")])
def test_comment_names_types_that_compile_to_its_result(name):
    kernel, comment, module = KERNELS[name]
    arguments, result = promised(comment, module)
    assert len(arguments) == len(inspect.signature(kernel.py_func).parameters)
    kernel.compile(arguments)
    found = kernel.overloads[arguments].signature.return_type
    assert isinstance(found, types.Array) == isinstance(result, types.Array)
    assert (
        (found.dtype, found.ndim) == (result.dtype, result.ndim) if isinstance(found, types.Array) else found == result
    )
