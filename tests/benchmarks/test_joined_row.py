"""The rows on mosaics and changes: surfaces with known errors are joined, changed and judged."""

from __future__ import annotations

import numpy as np
import pytest

from overlapping_surfaces import noise, stated_sigma, town, write_raster, write_run
from rows import joined
from workplace import Workplace

SIDE = 160


@pytest.fixture
def one_seed(monkeypatch):
    """One seed, and surfaces with made-up errors in place of rendered and matched ones."""

    def towns(out, seed):
        rng, truth, scene = np.random.default_rng(seed), town(SIDE, SIDE), out / f"town{seed}"
        write_raster(scene / "truth_dsm.tif", truth.astype(np.float32))
        folders = {}
        for name in joined.VIEWS:
            sigma = stated_sigma(rng, truth.shape, 0.2)
            z = truth + sigma * noise(rng, truth.shape, 1.5)
            flags = {"quality": np.zeros(z.shape, np.uint16)}
            flags |= {layer: np.ones(z.shape, np.uint8) for layer in ("views", "ortho", "water")}
            folders[name] = write_run(scene / name, z, sigma, **flags)
            (scene / name / "run.json").write_text("{}")
        return folders

    monkeypatch.setattr(joined, "towns", towns)
    monkeypatch.setattr(joined, "fresh_seeds", lambda: [3])


@pytest.mark.usefixtures("one_seed")
def test_runs_are_joined_and_changed(tmp_path):
    figures = {figure.what: figure for figure in joined.mosaic(Workplace(None, tmp_path / "mosaic"))}
    step = figures["step along the seam, 95th percentile, standard deviations, mean"]
    assert step.value > 0.0
    assert step.passes
    assert figures["planted offset found, error, worst"].value < 0.05
    figures = {figure.what: figure for figure in joined.change(Workplace(None, tmp_path / "change"))}
    assert figures["errors of volumes in standard deviations, largest: a mismatch"].value < 3.5
    assert figures["unchanged cells called changed at 5 %, worst town"].passes


def test_a_step_that_no_run_has_is_seen():
    runs = np.stack([np.zeros((4, 6)), np.ones((4, 6))])
    runs[0, :, 4:], runs[1, :, :2] = np.nan, np.nan
    source = np.where(np.arange(6) < 3, 1.0, 2.0) * np.ones((4, 1))
    hard = np.where(np.arange(6) < 3, 0.0, 1.0) * np.ones((4, 1))
    steps = joined.seam_steps(hard, runs, source)
    assert steps[1, :, 2] == pytest.approx(1.0)
    assert np.isnan(steps[1, :, 0]).all()
    soft = np.clip((np.arange(6) - 1.0) / 3.0, 0.0, 1.0) * np.ones((4, 1))
    assert np.nanmax(joined.seam_steps(soft, runs, source)) == pytest.approx(1.0 / 3.0)
