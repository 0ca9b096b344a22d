"""Heights of a part of the rendered town from six views with default options, against the exact truth."""

from __future__ import annotations

import json

import numpy as np
import pytest
import rasterio

from rendered_scenes import run

# Shares of the cells within 1 m of the truth. The whole town is more accurate than this part, which contains towers.
WITHIN_M, GROUND, BUILDINGS, ALL = 1.0, 0.95, 0.75, 0.90
NMAD_M = 0.2
SIDE_M = 76.0


@pytest.fixture(scope="module")
def town(shared_data, tmp_path_factory):
    """Heights, truth and classes of the middle of the town, on its cells of 0.5 m."""
    folder = shared_data / "rendered-city"
    with rasterio.open(folder / "truth_dsm.tif") as truth, rasterio.open(folder / "truth_class.tif") as classes:
        west, north = (truth.bounds.left + truth.bounds.right) / 2, (truth.bounds.top + truth.bounds.bottom) / 2
        west, north = np.round([west - SIDE_M / 2, north + SIDE_M / 2])
        bounds = (west, north - SIDE_M, west + SIDE_M, north)
        window = truth.window(*bounds)
        fine, kind = truth.read(1, window=window), classes.read(1, window=window)
    inputs = tuple(folder / f"img_{name}.tif" for name in ("n1", "f1", "b1", "n2", "f2", "b2"))
    out = run(inputs, tmp_path_factory.mktemp("town") / "out", heights=None, bounds=bounds).out
    with rasterio.open(out / "dsm.tif") as dsm:
        height = dsm.read(1)
    # A cell covers four cells of the truth. Its true height is their mean if they are alike; otherwise it has none.
    side = height.shape[0]
    parts = fine.reshape(side, 2, side, 2).swapaxes(1, 2).reshape(side, side, 4)
    kinds = kind.reshape(side, 2, side, 2).swapaxes(1, 2).reshape(side, side, 4)
    clear = (np.ptp(parts, axis=2) < 0.5) & (np.ptp(kinds, axis=2) == 0)
    return height - parts.mean(axis=2), np.where(clear, kinds[..., 0], 255), out


def test_heights_of_a_town(town):
    error, kind, out = town
    assert error.shape == (152, 152)
    near = np.abs(error) < WITHIN_M  # False for an empty cell.
    ground, buildings = near[kind <= 1].mean(), near[kind == 2].mean()
    assert ground > GROUND
    assert buildings > BUILDINGS
    assert near[kind <= 2].mean() > ALL
    flat = error[(kind <= 1) & np.isfinite(error)]
    assert 1.4826 * np.median(np.abs(flat - np.median(flat))) < NMAD_M
    assert abs(np.median(flat)) < 0.05
    assert json.loads((out / "run.json").read_text())["coverage"] > 0.97


def test_exact_rpcs_are_corrected_by_noise_only(town):
    """The RPCs of the town have no pointing errors, so corrections are tenths of a pixel at most."""
    views = json.loads((town[2] / "run.json").read_text())["orientation"]["views"]
    assert len(views) == 6
    assert max(np.abs(view["shift_px"]).max() for view in views.values()) < 0.2
