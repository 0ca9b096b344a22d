"""Crowns of trees with branches, leaves and gaps, for ground pixels of a few centimetres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zlocus.core.sensor_model import FloatArray

TALLEST_TREE_M = 15.0
SHARE_OF_BUSHES, SHARE_OF_CONIFERS = 0.3, 0.2
# Branches of a broadleaved crown, and their radius by that of the crown.
N_BRANCHES, BRANCH_RADIUS = 28, (0.22, 0.42)
LEAF_M, LEAF_DEPTH_M = 0.10, 0.35
GAP_M, SHARE_OF_GAPS = 0.18, 0.05


@dataclass(frozen=True)
class Crown:
    """Size of a crown. trunk_m : height of its lowest leaves."""

    radius_m: float
    height_m: float
    trunk_m: float
    is_conifer: bool


def drawn_crown(rng: np.random.Generator) -> Crown:
    """A bush, a conifer or a broadleaved tree of random size."""
    kind = rng.random()
    if kind < SHARE_OF_BUSHES:
        radius = rng.uniform(0.5, 1.3)
        return Crown(radius, radius * rng.uniform(1.2, 2.0), 0.1, False)
    is_conifer = kind < SHARE_OF_BUSHES + SHARE_OF_CONIFERS
    radius = rng.uniform(1.3, 2.6) if is_conifer else rng.uniform(1.6, 4.6)
    height = min(TALLEST_TREE_M, radius * (rng.uniform(3.0, 5.0) if is_conifer else rng.uniform(1.9, 3.0)))
    return Crown(radius, height, 0.1 * height if is_conifer else 0.3 * height, is_conifer)


def crown_tops(
    crown: Crown, p: FloatArray, q: FloatArray, step: float, rng: np.random.Generator
) -> NDArray[np.float64]:  # fmt: skip
    """Heights (r, c) m of a crown above the foot of its tree; -inf beside the crown and in its gaps.

    p, q : distances (m) of cells from the middle, (1, c) and (r, 1) or of the same shape; step : side of a cell, m.
    """
    p, q = np.broadcast_arrays(p, q)
    tops = _cone(crown, p, q, rng) if crown.is_conifer else _branches(crown, p, q, rng)
    leaves = _patches(p.shape, LEAF_M, step, rng)
    tops -= LEAF_DEPTH_M * min(1.0, crown.radius_m) * leaves**2
    tops -= 0.3 * LEAF_DEPTH_M * rng.random(p.shape)
    gaps = _patches(p.shape, GAP_M, step, rng) < SHARE_OF_GAPS
    tops[gaps | (tops < 0.3 * crown.trunk_m)] = -np.inf
    return np.asarray(tops)


def _branches(crown: Crown, p: FloatArray, q: FloatArray, rng: np.random.Generator) -> FloatArray:
    """The upper side of balls of leaves that are spread over half an ellipsoid."""
    tops = np.full(p.shape, -np.inf)
    depth = crown.height_m - crown.trunk_m
    for k in range(N_BRANCHES):
        radius = rng.uniform(*BRANCH_RADIUS) * crown.radius_m
        far = (crown.radius_m - radius) * np.sqrt((k + 0.5) / N_BRANCHES)
        angle = 2.4 * k + rng.normal(0.0, 0.3)
        middle = crown.trunk_m + (depth - radius) * np.sqrt(1.0 - (far / crown.radius_m) ** 2) * rng.uniform(0.85, 1.0)
        squared = radius**2 - (p - far * np.cos(angle)) ** 2 - (q - far * np.sin(angle)) ** 2
        tops = np.maximum(tops, np.where(squared > 0, middle + np.sqrt(np.maximum(squared, 0.0)), -np.inf))
    return tops


def _cone(crown: Crown, p: FloatArray, q: FloatArray, rng: np.random.Generator) -> FloatArray:
    """A cone whose rim is broken up by branches."""
    far = np.hypot(p, q) / crown.radius_m
    angle = np.arctan2(q, p)
    rim = 0.85 + 0.1 * np.sin(7.0 * angle + rng.uniform(0.0, 6.0)) + 0.06 * np.sin(17.0 * angle + rng.uniform(0.0, 6.0))
    tops = crown.trunk_m + (crown.height_m - crown.trunk_m) * (1.0 - far / rim)
    return np.where(far < rim, tops, -np.inf)


def _patches(shape: tuple[int, ...], side_m: float, step: float, rng: np.random.Generator) -> FloatArray:
    """Uniform random numbers (r, c) in [0, 1) that are the same over squares of about `side_m`."""
    n = max(1, round(side_m / step))
    values = rng.random([size // n + 1 for size in shape])
    return np.asarray(np.kron(values, np.ones((n, n)))[: shape[0], : shape[1]])
