"""`zlocus mosaic` on runs with known errors: the step along its seams, offsets, files, and bytes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine

from overlapping_surfaces import CELL_M, CORNER, two_runs, write_raster, write_run
from zlocus.core.errors import ConfigError, InputError, OutputError
from zlocus.core.progress import KeptNotes, SilentProgress
from zlocus.core.surface_requests import MosaicRequest
from zlocus.io.styles.file_names import style_files
from zlocus.matching.quality import Quality
from zlocus.pipeline.mosaic import run_mosaic
from zlocus.products.blending import SeamKind

# The bar of the issue: 95th percentile of the step along the seam, in standard deviations.
MAX_STEP_SIGMAS = 0.3


def mosaic(out, *inputs, progress=None, **more):
    return run_mosaic(MosaicRequest(tuple(map(str, inputs)), out, **more), progress or SilentProgress())


def read(path):
    with rasterio.open(path) as file:
        return file.read(1)


def record(out):
    return json.loads((out / "run.json").read_text())


@pytest.fixture(scope="module")
def joined(tmp_path_factory):
    folder = tmp_path_factory.mktemp("joined")
    runs = two_runs(folder, seed=1)
    mosaic(folder / "out", *runs.folders)
    return runs, folder / "out"


def steps_along_seams(heights, runs, there, source):
    """Steps between neighbours that exceed those of every run, where a run begins or ends or the chosen one changes."""
    found = []
    for axis in (0, 1):
        before = (slice(0, -1), slice(None)) if axis == 0 else (slice(None), slice(0, -1))
        after = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
        of_runs = np.stack([run[after] - run[before] for run in runs])
        step, known = heights[after] - heights[before], np.isfinite(of_runs).any(axis=0)
        low = np.where(np.isfinite(of_runs), of_runs, np.inf).min(axis=0)
        high = np.where(np.isfinite(of_runs), of_runs, -np.inf).max(axis=0)
        seam = (there[(slice(None), *before)] != there[(slice(None), *after)]).any(axis=0)
        seam |= source[before] != source[after]
        chosen = seam & known & np.isfinite(step)
        found.append((np.maximum(np.maximum(low - step, step - high), 0.0), chosen, before, after))
    return found


def test_the_step_along_the_seam(joined):
    runs, out = joined
    heights, sigma, source = (read(out / name).astype(float) for name in ("dsm.tif", "sigma.tif", "source.tif"))
    removed = [each["offset_removed_m"] for each in record(out)["runs"]]
    moved = runs.z - np.array(removed)[:, None, None]
    relative = [
        (step / np.fmax(sigma[before], sigma[after]))[chosen]
        for step, chosen, before, after in steps_along_seams(heights, moved, np.isfinite(runs.z), source)
    ]
    relative = np.concatenate(relative)
    assert relative.size > 500
    assert np.percentile(relative, 95) <= MAX_STEP_SIGMAS


def test_heights_are_as_good_as_the_standard_deviations_say(joined):
    runs, out = joined
    heights, sigma, kind = (read(out / name) for name in ("dsm.tif", "sigma.tif", "seams.tif"))
    offset = record(out)["runs"][1]["offset_removed_m"] - runs.offset_m
    error = (heights - runs.truth) / sigma
    assert 0.9 < np.nanstd(error[kind == SeamKind.BLENDED]) < 1.15
    both = np.isfinite(runs.z).all(axis=0) & (kind == SeamKind.BLENDED)
    single = [np.std((z - runs.truth - k * runs.offset_m)[both]) for k, z in enumerate(runs.z)]
    # The better run ends here, too, so most of the overlap is transition.
    assert np.std((heights - runs.truth)[both]) < 0.95 * np.mean(single)
    assert abs(offset) < 3.5 * record(out)["offsets"]["runs"][1]["sigma_m"]


def test_what_only_one_run_has_seen_is_chosen_and_flagged(joined):
    runs, out = joined
    kind, quality, heights = (read(out / name) for name in ("seams.tif", "quality.tif", "dsm.tif"))
    truck = np.zeros(kind.shape, bool)
    truck[20:30, 120:132] = True
    assert (kind[truck] == SeamKind.CHOSEN).mean() > 0.95
    assert ((quality[kind == SeamKind.CHOSEN] & Quality.DISPUTED) != 0).all()
    apart = np.abs(heights - runs.truth)[truck]
    assert ((apart < 1.5) | (apart > 2.5)).all(), "no height between car and ground"


def test_files_and_record(joined):
    runs, out = joined
    names = {path.name for path in out.iterdir()}
    rasters = {"dsm.tif", "sigma.tif", "quality.tif", "source.tif", "seams.tif"}
    styles = {name for raster in rasters for name in style_files(raster)}
    assert names == {*rasters, *styles, "seams.png", "run.json"}
    with rasterio.open(out / "source.tif") as file:
        assert file.tags(1)["RUNS"] == "; ".join(f"{k} {folder.name}" for k, folder in enumerate(runs.folders, 1))
    run = record(out)
    assert run["command"] == "zlocus mosaic"
    assert [each["path"] for each in run["inputs"]][:2] == [str(runs.folders[0] / n) for n in ("dsm.tif", "sigma.tif")]
    assert all(len(each["sha256"]) == 64 for each in run["inputs"])
    assert run["offsets"]["removed"] is True
    assert sum(run["cells"].values()) == runs.truth.size
    with rasterio.open(out / "dsm.tif") as file:
        assert file.transform.almost_equals(CORNER)
        assert file.shape == runs.truth.shape
        assert file.descriptions == ("height above the ellipsoid",)
    empty = read(out / "seams.tif") == SeamKind.EMPTY
    assert np.array_equal(np.isnan(read(out / "dsm.tif")), empty)
    assert (read(out / "quality.tif")[empty] != 0).all()


@pytest.mark.parametrize("workers", [2])
def test_processes_make_the_same_bytes(joined, tmp_path, workers):
    runs, out = joined
    mosaic(tmp_path / "again", *runs.folders, workers=workers)
    for name in ("dsm.tif", "sigma.tif", "quality.tif", "source.tif", "seams.tif"):
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes(), name


def test_blocks_leave_no_trace(joined, tmp_path, monkeypatch):
    runs, out = joined
    monkeypatch.setattr("zlocus.pipeline.surface_workers.blocks_of.__defaults__", (96,))
    mosaic(tmp_path / "again", *runs.folders)
    assert np.allclose(read(tmp_path / "again" / "dsm.tif"), read(out / "dsm.tif"), atol=1e-4, equal_nan=True)


def test_offsets_are_kept_on_request(joined, tmp_path):
    runs, _ = joined
    notes = KeptNotes()
    mosaic(tmp_path / "kept", *runs.folders, keep_offsets=True, progress=notes)
    assert any("Offsets stay" in sentence for sentence in notes.sentences)
    east = read(tmp_path / "kept" / "dsm.tif")[:, 200:]
    assert np.nanmedian(east - runs.truth[:, 200:]) == pytest.approx(runs.offset_m, abs=0.1)


def test_layers_of_runs_follow_the_chosen_run(tmp_path):
    z = np.full((60, 80), 10.0)
    folders = []
    for number, shift in enumerate((0, 50)):
        views = np.full(z.shape, 3 + number, np.uint8)
        quality = np.full(z.shape, Quality.WEAK if number else Quality.JUMP, np.uint16)
        folder = write_run(
            tmp_path / f"run{number}", z, np.full(z.shape, 0.2), CORNER * Affine.translation(shift, 0),
            views=views, quality=quality, water=np.full(z.shape, number, np.uint8),
        )  # fmt: skip
        with rasterio.open(folder / "dsm.tif") as file:
            profile = file.profile | {"dtype": "uint16", "nodata": None, "count": 3, "photometric": "RGB"}
        with rasterio.open(folder / "ortho.tif", "w", **profile) as file:
            file.write(np.full((3, *z.shape), 100 + number, np.uint16))
        folders.append(folder)
    mosaic(tmp_path / "out", *folders)
    source = read(tmp_path / "out" / "source.tif")
    assert set(np.unique(source)) == {1, 2}
    assert np.array_equal(read(tmp_path / "out" / "views.tif"), source + 2)
    assert np.array_equal(read(tmp_path / "out" / "ortho.tif"), source + 99)
    assert np.array_equal(read(tmp_path / "out" / "water.tif"), source - 1)
    assert np.array_equal(read(tmp_path / "out" / "quality.tif"), np.where(source == 1, Quality.JUMP, Quality.WEAK))


def test_a_mosaic_is_part_of_another_one(joined, tmp_path):
    runs, out = joined
    more = write_run(tmp_path / "more", runs.truth, np.full(runs.truth.shape, 0.3), CORNER * Affine.translation(0, 150))
    mosaic(tmp_path / "all", out, more)
    assert record(tmp_path / "all")["grid"]["shape"] == [330, 240]


def test_another_grid(joined, tmp_path):
    runs, _ = joined
    like = write_raster(
        tmp_path / "like.tif", np.zeros((50, 60), np.float32), Affine(1.0, 0, 4e5 + 20, 0, -1.0, 5e6 - 9)
    )
    notes = KeptNotes()
    mosaic(tmp_path / "out", *runs.folders, like=like, feather_m=8 * CELL_M, progress=notes)
    assert any("do not lie on the grid" in sentence for sentence in notes.sentences)
    assert read(tmp_path / "out" / "dsm.tif").shape == (50, 60)


def test_rasters_without_standard_deviations(joined, tmp_path):
    runs, _ = joined
    notes = KeptNotes()
    mosaic(tmp_path / "out", runs.folders[0], runs.folders[1] / "dsm.tif", progress=notes)
    assert any("states no standard deviation: 0." in sentence for sentence in notes.sentences)
    assert np.isfinite(read(tmp_path / "out" / "sigma.tif")[100, 230])


def test_what_is_refused_leaves_nothing(joined, tmp_path):
    runs, out = joined
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(OutputError, match=r"holds another result \(run\.json"):
        mosaic(out, *runs.folders)
    with pytest.raises(ConfigError, match=r"is 2000 cells\. Give a distance between 1 and 128 m"):
        mosaic(tmp_path / "new", *runs.folders, feather_m=1000.0)
    far = write_raster(tmp_path / "far.tif", np.zeros((9, 9), np.float32), Affine(1, 0, 9e5, 0, -1, 5e6))
    with pytest.raises(InputError, match="has no cell on the grid of the mosaic"):
        mosaic(tmp_path / "new", runs.folders[0], runs.folders[1], far, like=runs.folders[0] / "dsm.tif")
    assert not (tmp_path / "new").exists()
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_a_damaged_run_leaves_the_earlier_result(joined, tmp_path):
    runs, _ = joined
    mosaic(tmp_path / "out", *runs.folders)
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    damaged = tmp_path / "damaged.tif"
    damaged.write_bytes(Path(runs.folders[1] / "dsm.tif").read_bytes()[:-30_000])
    with pytest.raises(InputError, match="damaged"):
        mosaic(tmp_path / "out", runs.folders[0], damaged, overwrite=True)
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
