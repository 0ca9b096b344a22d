"""Surfaces and kernels on other processors, imitated by variables that switch off instructions of this one."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import rasterio

import processors
from benchmark_scripts import printed_table, run_script
from places import TESTS
from rendered_scenes import rendered

# Of a surface whose libraries take their code for a processor without AVX2 and FMA, measured on larger scenes
# (docs/development/experiments/processors.md): heights change in a share of the cells, nearly all by less than 1 mm.
MAX_SHARE_ABOVE_1_MM = 0.02


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A folder with three images, as the script takes another scene."""
    folder = tmp_path_factory.mktemp("scene")
    for name, path in rendered(folder / "rendered", "sine").paths.items():
        path.rename(folder / f"img_{name}.tif")
    return folder


def measured(monkeypatch, capsys, scene, out, *settings):
    found = run_script(monkeypatch, processors, "--scene", scene, "-o", out, "--settings", *settings)
    rows = printed_table(capsys.readouterr().out)
    assert [row["setting"] for row in rows] == list(settings)
    return {setting: difference for (_, setting), difference in found.items()}


def test_libraries_for_other_processors_make_the_same_bytes(scene, tmp_path, monkeypatch, capsys):
    """Of all processors with AVX2 and FMA, which is what they have had since 2013 (Intel) and 2017 (AMD); without these
    heights differ by less than what matters."""
    modern, old = f"{processors.V3}all libraries", f"{processors.V2}all libraries"
    found = measured(monkeypatch, capsys, scene, tmp_path, modern, old)
    assert found[modern].rasters == ()
    assert found[old].changed_1_mm < MAX_SHARE_ABOVE_1_MM


def test_kernels_of_other_processors_compute_the_same(tmp_path):
    """A few kernels, compiled for this processor, which fuses multiplication and addition, and for one without."""
    digests = {}
    for name in ("", "x86-64"):
        variables = processors.SETTINGS[f"kernels for {name}"] if name else {}
        if not processors.usable(variables):
            continue
        place = {"NUMBA_CACHE_DIR": str(tmp_path / name)} if name else {}
        done = subprocess.run(
            [sys.executable, str(TESTS / "support" / "processor_kernels.py")], capture_output=True, text=True,
            env=os.environ | variables | place,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        digests[name] = done.stdout.strip()
        assert not name or list((tmp_path / name).rglob("*.nbc")), "compiled for that processor"
    assert len(set(digests.values())) == 1, digests
    assert len(digests[""]) == 64


def test_differences_are_counted(tmp_path):
    for folder in ("usual", "same", "other"):
        (tmp_path / folder).mkdir()
        heights = np.arange(100, dtype=np.float32).reshape(10, 10)
        if folder == "other":
            heights[0, :3] += np.float32(2e-4)
            heights[1, :2] += np.float32(0.5)
            heights[2, 0] = np.nan
        for name in processors.RASTERS:
            with rasterio.open(
                tmp_path / folder / f"{name}.tif", "w", driver="GTiff", width=10, height=10, count=1, dtype="float32",
                transform=rasterio.transform.from_origin(462000, 5247000, 1, 1), crs="EPSG:32632",
            ) as file:  # fmt: skip
                file.write(heights if name == "dsm" else 0 * np.nan_to_num(heights), 1)
    assert processors.difference(tmp_path / "usual", tmp_path / "same").rasters == ()
    found = processors.difference(tmp_path / "usual", tmp_path / "other")
    assert found.rasters == ("dsm",)
    assert found.changed == pytest.approx(0.06)
    assert found.changed_1_mm == pytest.approx(0.03)
    assert found.largest_m == pytest.approx(0.5)
    assert 2e-4 < found.within_m <= found.largest_m
    assert found.cells.startswith("dsm | 6 % | 3 % | 0.")
