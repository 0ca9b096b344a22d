"""The signature comment above each kernel: as many arguments as the function takes, of the types it is called with."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re

import numpy as np
import pytest
from numba import typeof
from numba.core import types

import zlocus.kernels
from kernel_scene import even_lattice, kernel_scene

LETTERS = {"float32": "f4", "float64": "f8", "int32": "i4", "int64": "i8", "uint8": "u1", "uint16": "u2",
           "uint32": "u4", "bool": "b1", "none": "None"}  # fmt: skip


def all_kernels():
    """Every kernel by name, with the comment above its decorator."""
    found = {}
    for module in pkgutil.iter_modules(zlocus.kernels.__path__):
        if module.name.startswith("_"):
            continue
        loaded = importlib.import_module(f"zlocus.kernels.{module.name}")
        source = inspect.getsource(loaded)
        for comment, name in re.findall(r"# (.*)\n@(?:parallel_)?kernel\ndef (\w+)\(", source):
            found[name] = (getattr(loaded, name), comment)
        assert len(re.findall(r"\n@(?:parallel_)?kernel\n", source)) == source.count("kernel\ndef "), module.name
    return found


KERNELS = all_kernels()


def letters(kind):
    """A Numba type as the comments write it: `(,) f4` for each dimension a place."""
    kind = types.unliteral(kind)
    if isinstance(kind, types.Array):
        return f"{kind.ndim}d {LETTERS[str(kind.dtype)]}"
    return LETTERS[str(kind)]


def promised(comment):
    """Arguments and result of a comment, in the same letters."""
    arguments, result = comment.split(" -> ")
    places = re.findall(r"(?:\(([^)]*)\) )?([fiub]\d)", arguments)
    kinds = [f"{len([p for p in shape.split(',') if p])}d {kind}" if shape else kind for shape, kind in places]
    return kinds, result


def calls():
    """Small valid arguments of every kernel with a comment of its own."""
    f4, f8, i8, u2 = np.float32, np.float64, np.int64, np.uint16
    scene, lattice = kernel_scene(2, (8, 8), 8), even_lattice(16, (8, 8), 8)
    width, half = 10, 1
    n = 8 * width - 2 * half
    seen, size = scene.all_seen(), 10 * width
    plane = lambda *shape: np.ones((*shape, size), f4)  # noqa: E731
    grid, grids = np.array([9, 8, 1, 0, 0, 1, 0, 0], f8), np.tile(np.array([9, 8, 1, 0, 0, 1, 0, 0], f8), (3, 1))
    volume, total = np.ones(lattice.size, np.uint8), np.ones(lattice.size, u2)
    reach, surface = np.empty((2, 2, 8, 8), np.int32), np.full((8, 8), 5, f4)
    blocked, free = np.zeros(len(scene.pixels), bool), np.zeros(2, bool)
    span, halves = np.array([0, 16], i8), np.array([1], i8)
    p2, paths, least = np.ones((4, 8, 8), u2), np.ones(2000, u2), np.ones((4, 10), u2)
    spots, planes = np.arange(2, 402, 50).reshape(2, 4), 2 + 160 * np.arange(12).reshape(3, 4)
    segments = np.tile(np.array([[0, 0, 0], [-1, 16, -1], [0, 0, 8], [2, 2, 2]], i8), (2, 1, 1))
    picks = np.zeros((2, 8, 8), np.int32)
    views = (scene.pixels, scene.layout, scene.nodes, scene.heights)
    return {
        "product_rows": (plane(), plane(), half, n, plane()),
        "row_sums": (plane(), half, n, plane()),
        "column_sums": (plane(), half, width, n, plane()),
        "window_moments": (plane(), 0, half, width, n, f4(0), plane(), plane(), plane()),
        "pair_sum": (plane(2), 0, plane(2), plane(2), half, width, n, plane(2), plane()),
        "resample_plane": (
            scene.pixels, scene.layout[0], grid, np.empty(8, np.uint32), np.empty((2, 8), f4), surface.copy(),
        ),
        "plane_grid": (scene.nodes, 0, 0.5, 8, 1, grid.copy()),
        "flat_visibility": (seen, half, np.empty((2, 2, size), np.int32), plane()),
        "block_costs": (*views, span, halves, seen, 8, f4(0), volume.reshape(8, 128).copy()),
        "path_cost": tuple(u2(v) for v in (5, 6, 7, 1, 9, 5, 3)),
        "run_cells": (
            volume, total.copy(), 0, np.array([16, 1], i8), paths, spots, least, least.copy(), least, 0, u2(1),
        ),
        "shifted": (paths, 2, 16, 1, 100, 16),
        "row_segments": (lattice.ranges, 0, 8, 8, 1, segments[0].copy()),
        "row_edges": (p2, 0, -1, np.empty((4, 8), u2)),
        "alike": (segments[0], 1, segments[1], 1),
        "find_neighbours": (paths, planes, segments, 0, 0, 1, 0, spots.copy()),
        "sweep_segment": (
            volume, total.copy(), 0, paths, planes, segments, 0, 0, 1, np.ones((2, 4, 10), u2), least, u2(1),
        ),
        "reverse_cells": (volume, 0, 16, 8, volume.copy()),
        "add_reversed": (total, 0, 16, 8, total.copy()),
        "least_sum": (total[:16],),
        "other_minimum": (total[:16], 5),
        "sweep": (volume, lattice.ranges, lattice.address, 8, p2, u2(1), 1, total.copy()),
        "winners": (total, lattice.ranges, lattice.address, 8, *picks, np.empty((8, 8), u2), surface.copy()),
        "lowest_visible": (surface, 0.5, 0.2, surface.copy()),
        "smooth_surface": (surface, 1, f4(1), f4(3), surface.copy()),
        "surely_inside": (scene.nodes, 0, 0.0, 0.5, 8, 3.0, scene.layout[0]),
        "plane_cover": (grid, np.array([8, 8]), 3.0, scene.layout[0], blocked, True),
        "lengthen": (picks[0], 2, 9, picks[0].copy(), reach[0, 0].copy(), reach[1, 0].copy()),
        "step_cells": (grid, 3.0, scene.layout[0], blocked, True, picks[0].copy()),
        "block_reach": (
            blocked, free, scene.layout, scene.nodes, scene.heights, span, 8, 3.0, reach[0].copy(), reach[1].copy(),
        ),
        "row_positions": (grids, 0, 3, 9.0, np.empty(6, f4)),
        "spline_weights": (surface[0], np.ones(6, f4), f4(0), f4(9), np.empty(8, np.int32), np.empty((4, 8), f4)),
        "spline_gather": (
            scene.pixels, np.int32(0), np.int32(16), np.zeros((2, 8), np.int32), np.ones((4, 8), f4),
            np.ones((4, 8), f4), surface[0].copy(),
        ),
        "resample_surface": (scene.pixels, scene.layout[0], grids, surface * f4(0.1), surface.copy()),
        "block_profile": (
            *views, np.full((10, 10), 5, f4), np.zeros(1, f4), 8, 1, seen, f4(0), np.empty((1, 8, 8), f4),
        ),
        "tile_ortho": (*views, surface, 0, 8, surface.copy()),
    }  # fmt: skip


CALLS = calls()


def test_every_kernel_has_a_comment():
    assert len(KERNELS) >= 20
    unknown = [
        name for name, (_, comment) in KERNELS.items() if " -> " not in comment and not comment.startswith("as ")
    ]
    assert not unknown
    own = {name for name, (_, comment) in KERNELS.items() if not comment.startswith("as ")}
    assert own == set(CALLS)


@pytest.mark.parametrize("name", sorted(CALLS))
def test_comment_names_the_types_of_a_call(name):
    kernel, comment = KERNELS[name]
    arguments, result = promised(comment)
    assert len(arguments) == len(inspect.signature(kernel.py_func).parameters)
    assert arguments == [letters(typeof(value)) for value in CALLS[name]]
    kernel(*CALLS[name])
    compiled = [overload.signature for overload in kernel.overloads.values()]
    used = [s for s in compiled if [letters(kind) for kind in s.args] == arguments]
    assert used
    assert letters(used[0].return_type) == result
