"""Seeds that follow from the last commit, and figures of mean and spread over several scenes."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import rasterio

import judging
import result_files
import seeds
from rows import fresh
from seeds import fresh_seeds, mean_and_spread, over_seeds
from workplace import CannotRun, Figure

# The shared judge rounds its figures to this.
ROUNDED = 1e-3
# Two searches for a shift end some centimetres apart, which moves single blocks at edges across the limit.
ALIGNED_ALIKE = 0.02
# Share of the blocks at the edges of roofs, where either side is right.
EDGES = 0.05


def git(folder: Path, *words: str) -> str:
    named = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
    return subprocess.run(["git", *named, *words], cwd=folder, check=True, capture_output=True, text=True).stdout


def commit(folder: Path, name: str, text: str) -> str:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    git(folder, "add", name)
    git(folder, "commit", "-q", "-m", text)
    return git(folder, "rev-parse", "HEAD").strip()


@pytest.fixture
def repository(tmp_path, monkeypatch) -> Path:
    folder = tmp_path / "repository"
    folder.mkdir()
    git(folder, "init", "-q")
    monkeypatch.setattr(result_files, "ROOT", folder)
    return folder


def test_seeds_follow_from_the_last_commit_that_touches_the_source(repository):
    commit(repository, "src/a.py", "1")
    last = commit(repository, "src/a.py", "2")
    commit(repository, "docs/b.md", "3")
    assert fresh_seeds(3) == [int(last[:8], 16) + k for k in range(3)]
    assert len(fresh_seeds()) == seeds.N_SEEDS == 10


def test_without_the_whole_history_there_are_no_seeds(repository, tmp_path, monkeypatch):
    commit(repository, "docs/b.md", "1")
    with pytest.raises(CannotRun, match="No commit touches src/"):
        fresh_seeds()
    commit(repository, "src/a.py", "2")
    commit(repository, "docs/b.md", "3")
    git(tmp_path, "clone", "-q", "--depth", "1", f"file://{repository}", "shallow")
    monkeypatch.setattr(result_files, "ROOT", tmp_path / "shallow")
    with pytest.raises(CannotRun, match=r"the history of this clone is cut off. Complete it with `git fetch"):
        fresh_seeds()
    (tmp_path / "plain").mkdir()
    monkeypatch.setattr(result_files, "ROOT", tmp_path / "plain")
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path))
    with pytest.raises(CannotRun, match=r"there is none \(.*Measure in a git clone"):
        fresh_seeds()


def test_mean_spread_and_worst_of_several_seeds():
    values = {7: (0.5, 3.0), 8: (0.7, 1.0), 9: (0.9, 2.0)}

    def measure(seed: int) -> list[Figure]:
        share, error = values[seed]
        return [Figure("within 1 m", share, at_least=0.6, fails_when="x"), Figure("RMSE", error, "m")]

    lines = over_seeds(list(values), measure)
    found = {line.what: line.value for line in lines}
    assert found == pytest.approx(
        {
            "within 1 m, mean": 0.7, "within 1 m, standard deviation": 0.2, "within 1 m, worst": 0.5,
            "RMSE, mean": 2.0, "RMSE, standard deviation": 1.0, "RMSE, worst": 3.0,
        }
    )  # fmt: skip
    assert lines[0].bar == ">= 0.6"
    assert [line.bar for line in lines[1:]] == [""] * 5
    assert lines[4].unit == "m"
    assert mean_and_spread([Figure("a", 1.0)], min)[0].value == 1.0


def test_a_figure_that_a_seed_lacks_is_no_mean():
    with pytest.raises(CannotRun, match="1 of 2 seeds give `a`"):
        over_seeds([1, 2], lambda seed: [Figure("a", 1.0)] if seed == 1 else [])


def test_the_figures_of_a_seed_are_those_of_its_surface(small_town, small_surface):
    """As the surface is, and aligned, they are those of the judge of the benchmarks; only the first have bars."""
    lines = {line.what: line for line in fresh.seed_figures("six", small_surface / "dsm.tif", small_town, "city")}
    inputs = small_surface / "dsm.tif", small_town / "truth_dsm.tif", small_town / "truth_class.tif"
    judged, aligned = judging.judged(*inputs), judging.judged(*inputs, align=True)
    for kind in ("all", "ground", "building"):
        assert lines[f"six, within 1 m: {kind}"].value == pytest.approx(judged[kind]["within"], abs=ROUNDED)
        assert lines[f"six, aligned, within 1 m: {kind}"].value == pytest.approx(
            aligned[kind]["within"], abs=ALIGNED_ALIKE
        )
        assert not lines[f"six, aligned, within 1 m: {kind}"].bar
    assert lines["six, RMSE"].value == pytest.approx(judged["all"]["rmse"], abs=ROUNDED)
    labels = [re.sub(", aligned", "", what) for what in lines]
    assert labels[: len(labels) // 2] == labels[len(labels) // 2 :]


def test_empty_cells_are_not_within_and_not_off(small_town, tmp_path):
    """A surface that is right in one third, 5 m too high in one, and empty in the last."""
    with rasterio.open(small_town / "truth_dsm.tif") as truth:
        z, profile = truth.read(1), truth.profile
    third = z.shape[1] // 3
    z[:, third : 2 * third] += 5.0
    z[:, 2 * third :] = np.nan
    with rasterio.open(tmp_path / "dsm.tif", "w", **profile | {"nodata": np.nan, "dtype": "float32"}) as file:
        file.write(z.astype(np.float32), 1)
    lines = {line.what: line.value for line in fresh.seed_figures("six", tmp_path / "dsm.tif", small_town, "city")}
    # A margin of 10 m on each side is not judged, so the thirds are not equal.
    side_m, margin_m = z.shape[1] * profile["transform"].a, 10.0
    inner = side_m / 3 / (side_m - 2 * margin_m)
    assert lines["six, within 1 m: all"] == pytest.approx((1 - inner) / 2, abs=EDGES)
    assert lines["six, off by more than 3 m"] == pytest.approx(inner, abs=EDGES)
    assert lines["six, off by more than 10 m"] == pytest.approx(0, abs=EDGES)
