"""The row of the drone block: planted errors of a surface come out as figures, and a block is rendered once."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from rows import drone_block as row
from workplace import CannotRun, Usage, Workplace
from zlocus.synthetic.drone_block import DroneBlockSpec, render_drone_block, small_drone_block_spec

SIDE_M = 18.0
# Planted on the western half of the surface, and on its first rows.
OFF_M, WRONG_M = 0.2, 5.0
# Share of the cells that lie on hedges, where heights differ inside a cell and the nearest one is right.
SHARE = 0.05


@pytest.fixture(scope="module")
def spec() -> DroneBlockSpec:
    """Bare ground without relief that differs between cells."""
    bare = {"houses_per_ha": 0.0, "trees_per_ha": 0.0, "cars_per_ha": 0.0, "samples": 1}
    return small_drone_block_spec(5, columns=240, rows=180, strips=1, frames_per_strip=2, forward_overlap=0.8, **bare)


@pytest.fixture(scope="module")
def rendered(spec: DroneBlockSpec, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_drone_block(spec, tmp_path_factory.mktemp("row") / "block").folder


def write_surface(truth: Path, out: Path, bounds: tuple[float, ...], step_m: float, shift_m: float = 0.0) -> None:
    """A surface from the truth, with planted errors. shift_m : moves it to the east."""
    with rasterio.open(truth) as source:
        heights, transform = source.read(1), source.transform
    n = round((bounds[2] - bounds[0]) / (3 * step_m))
    centre = (np.arange(n) + 0.5) * 3 * step_m
    col = np.floor((bounds[0] + centre - shift_m - transform.c) / step_m).astype(int)
    rows = np.floor((transform.f - bounds[3] + centre) / step_m).astype(int)
    z = np.mean([heights[np.ix_(rows + i, col + j)] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    z[:, : n // 2] += OFF_M
    z[: n // 10] += WRONG_M
    z[-n // 10 :] = np.nan
    out.mkdir(parents=True)
    profile = {"driver": "GTiff", "height": n, "width": n, "count": 1, "dtype": "float32", "crs": "EPSG:32632"}
    grid = from_origin(bounds[0], bounds[3], 3 * step_m, 3 * step_m)
    with rasterio.open(out / "dsm.tif", "w", **profile, transform=grid, nodata=np.nan) as file:
        file.write(z.astype(np.float32), 1)


def test_the_row_renders_matches_and_judges(
    spec: DroneBlockSpec, rendered: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a surface whose errors are known in place of the matching."""
    commands = []

    def matched(command: list[object], **options: object) -> Usage:
        commands.append(command)
        at = command.index("--bounds")
        bounds = tuple(float(value) for value in command[at + 1 : at + 5])
        out = tmp_path / "dsm"
        write_surface(tmp_path / "block" / "truth_dsm.tif", out, bounds, spec.step_m)
        stages = [{"name": "match", "cpu_s": 3.0, "peak_mb": 500.0}, {"name": "write", "cpu_s": 1.0, "peak_mb": 900.0}]
        (out / "run.json").write_text(json.dumps({"stages": stages}))
        return Usage(4.0, 0.9)

    monkeypatch.setattr(row, "run", matched)
    shutil.copytree(rendered, tmp_path / "block")
    workplace = Workplace(None, tmp_path)
    figures = {figure.what: figure for figure in row.drone_block(workplace, spec, SIDE_M)}
    assert len(commands) == 1
    assert workplace.inputs["seeds"] == [5]
    values = {name: figure.value for name, figure in figures.items()}
    # Nine tenths have a height, a tenth is wrong, and half of the rest is off by 0.2 m.
    assert values["with a height"] == pytest.approx(0.9, abs=SHARE)
    assert values["off by more than 3 m"] == pytest.approx(0.1, abs=SHARE)
    assert values["within 0.1 m: all"] == pytest.approx(0.4, abs=SHARE)
    assert values["within 0.3 m: all"] == pytest.approx(0.8, abs=SHARE)
    assert values["within 1 m: all"] == pytest.approx(0.8, abs=SHARE)
    million_cells = (SIDE_M / 0.6) ** 2 / 1e6
    assert values["CPU per million cells"] == pytest.approx(4.0 / million_cells)
    assert values["peak memory of a process"] == 0.9
    assert all(figure.fails_when for figure in figures.values() if figure.bar)


def test_the_shift_of_a_surface_is_removed(spec: DroneBlockSpec, rendered: Path, tmp_path: Path) -> None:
    """A surface is moved by half a metre up; in its height only, because bare ground shows no horizontal shift."""
    bounds = row._area(rendered / "truth_dsm.tif", spec, SIDE_M)
    write_surface(rendered / "truth_dsm.tif", tmp_path / "dsm", bounds, spec.step_m)
    with rasterio.open(tmp_path / "dsm" / "dsm.tif", "r+") as file:
        z = file.read(1)
        z[:, : z.shape[1] // 2] -= np.float32(OFF_M)
        file.write(z + np.float32(0.5), 1)
    row._cut_truth(rendered, bounds, tmp_path / "judged")
    values = {figure.what: figure.value for figure in row.accuracy(tmp_path / "dsm" / "dsm.tif", tmp_path / "judged")}
    assert values["within 0.3 m: all"] == 0.0
    assert values["shift up"] == pytest.approx(0.5, abs=0.02)
    assert values["aligned, within 0.1 m: all"] == pytest.approx(0.8, abs=SHARE)


def test_another_block_in_the_folder_is_not_used(spec: DroneBlockSpec, rendered: Path, tmp_path: Path) -> None:
    shutil.copytree(rendered, tmp_path / "block")
    with pytest.raises(CannotRun, match="holds another scene; remove it"):
        row.drone_block(Workplace(None, tmp_path), small_drone_block_spec(6), SIDE_M)


def test_either_side_of_an_edge_is_right() -> None:
    flat, edge = [5.0] * 9, [5.0] * 6 + [8.0] * 3
    found = row.errors_of_cells(np.array([5.5, 8.1, 6.0, np.nan]), np.array([flat, edge, edge, flat]))
    np.testing.assert_allclose(found, [0.5, 0.1, 1.0, np.nan], rtol=0, atol=1e-9)
