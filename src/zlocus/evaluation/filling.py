"""Why a surface fills no cell of a reference, so that nothing can be compared."""

from __future__ import annotations

import math

import numpy as np

from zlocus.core.errors import InputError
from zlocus.evaluation.frame import Points, converted, frame_of, points_on, unit_m
from zlocus.evaluation.heights import HeightRaster
from zlocus.evaluation.truth import TruthBlocks, places, truth_blocks


def why_nothing_compared(
    surface: HeightRaster, reference: HeightRaster, truth: TruthBlocks, points: Points, margin_m: float
) -> str:
    """Why no block of a reference has an error, as a sentence that says what to do.

    truth : the blocks of the reference that count. points : where the surface is looked up for them. margin_m : strip
    along the border of the reference that is left out.
    """
    if surface.filled_cells is None:
        return (
            f"{surface.path} holds no height at all, so nothing can be compared. See its quality.tif for the reasons."
        )
    n_touched, n = int(np.count_nonzero(points.reaching(surface))), len(truth.xy)
    advice = ["a larger surface", "a reference with heights there"]
    if points.areas is not None:
        advice = ["a finer reference", "a larger surface"]
    if margin_m > 0 and _n_filled_without_margin(surface, reference):
        advice.append("--margin 0, which counts the border of the reference too")
    size = _block_text(reference, surface, truth.size)
    filled = "at least half of one" if points.areas is not None else "the centre of one"
    return (
        f"{surface.path} fills none of the {n} cells of {size} of {reference.path} that count: its heights reach "
        f"into {n_touched} of them, and a comparison needs heights in {filled}. Give {_either(advice)}."
    )


def share_ground(surface: HeightRaster, reference: HeightRaster) -> bool:
    """Whether the grids of a surface and a reference overlap, even where the surface lies between centres of cells."""
    rows, cols = surface.z.shape
    row, col = (place.ravel() for place in np.meshgrid(np.linspace(0, rows, 5), np.linspace(0, cols, 5)))
    xy, mine, theirs = places(surface.transform, row, col), surface.horizontal, reference.horizontal
    cell = reference.cells(xy if mine is None or theirs is None else converted(mine, theirs, xy))
    return bool((cell.min(axis=0) < reference.z.shape).all() and (cell.max(axis=0) > 0).all())


def _n_filled_without_margin(surface: HeightRaster, reference: HeightRaster) -> int:
    """Number of blocks of a reference that a surface fills, those along its border among them."""
    frame = frame_of(surface, reference)
    try:
        truth = truth_blocks(reference, 0.0, None, frame)
    except InputError:
        return 0
    points = points_on(surface, reference, frame, truth.xy, truth.size, truth.is_edge)
    return int(np.count_nonzero(np.isfinite(points.heights(surface, HeightRaster.nearest))))


def _block_text(reference: HeightRaster, surface: HeightRaster, size: int) -> str:
    """Height and width of blocks of `size` cells on the ground, such as "92 x 65 m"."""
    t, (east_m, north_m) = reference.transform, unit_m(reference, frame_of(surface, reference))
    width_m, height_m = (size * math.hypot(x * east_m, y * north_m) for x, y in ((t.a, t.d), (t.b, t.e)))
    return f"{height_m:.2g} x {width_m:.2g} m"


def _either(choices: list[str]) -> str:
    """Choices as a phrase: a, b, or c."""
    *others, last = choices
    return f"{', '.join(others)} or {last}"
