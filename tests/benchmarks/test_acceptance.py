"""The acceptance table and what its rows share, run on small inputs."""

from __future__ import annotations

import json
import re
import shutil
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import acceptance
import audit
import coregistration
import judging
import middlebury
import reprojection
import workplace
from benchmark_scripts import DISPARITY_PX, printed_table, run_script, write_photographs
from rows import other_programs, rendered, resources
from workplace import CannotRun, Figure, Workplace
from zlocus.sensors.frame import FrameModel

# Of a small town with six views: a surface that is anything like it.
LEAST_WITHIN = 0.85
# A line of the table: row, what, figure with its unit, and, where there is one, a bar with its verdict.
LINE = re.compile(
    r"^\S+ +(?P<what>\S.*?) {2,}(?P<figure>\S+(?: \S+)?)(?: {2}(?P<bar>\S.*?))?(?: +(?P<verdict>pass|SHORT))?$"
)
# The judges round their figures to so much.
ROUNDED = 1e-3


@pytest.fixture
def small_data(shared_data, small_town, tmp_path) -> Path:
    """A data folder whose only scene is the small town, by the name of the shared one, beside the shared judge."""
    if not judging.JUDGE.exists():
        pytest.fail(f"{judging.JUDGE} is missing, beside {shared_data}: no row of the acceptance table can be judged")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "rendered-city").symlink_to(small_town)
    (tmp_path / "tools").mkdir()
    shutil.copy(judging.JUDGE, tmp_path / "tools")
    return tmp_path / "data"


def table_of(text: str) -> dict[str, tuple[str, str, str]]:
    """Figure, bar and verdict by what they are of."""
    found = [LINE.match(line) for line in text.splitlines()[1:]]
    assert all(found), text
    return {of["what"]: (of["figure"], of["bar"] or "", of["verdict"] or "") for of in found}


def test_a_row_of_the_acceptance_table(small_data, tmp_path, monkeypatch, capsys):
    """The town's, whose bars are for a larger one: what is short of them is told and does not fail."""
    monkeypatch.setenv("ZLOCUS_TEST_DATA", str(small_data))
    assert run_script(monkeypatch, acceptance, "city", "--keep", tmp_path / "kept") == 0
    figures = table_of(capsys.readouterr().out)
    plain = [*(f"within 1 m: {kind}" for kind in ("all", "ground", "building", "tree")), "NMAD ground"]
    of_memory = [f"peak memory by its plan, {which}" for which in ("least", "largest")]
    assert list(figures) == [*plain, *(f"aligned, {what}" for what in plain), *of_memory]
    for name, (figure, bar, verdict) in figures.items():
        value = float(figure.split()[0])
        if "within" in name:
            assert LEAST_WITHIN - (0.4 if name.endswith("tree") else 0) < value <= 1
        if bar:
            passes = value >= float(bar.split()[1]) if bar.startswith(">=") else value <= float(bar.split()[1])
            assert verdict == ("pass" if passes else "SHORT")
    assert figures["NMAD ground"][0].endswith(" m")
    # The other judge says the same.
    monkeypatch.setattr(judging, "JUDGE", tmp_path / "none")
    scene, dsm = small_data / "rendered-city", tmp_path / "kept" / "city" / "dsm.tif"
    found = judging.judged(dsm, scene / "truth_dsm.tif", scene / "truth_class.tif")
    for kind in ("all", "ground", "building", "tree"):
        assert found[kind]["within"] == pytest.approx(float(figures[f"within 1 m: {kind}"][0]), abs=ROUNDED)


def test_the_memory_of_runs_is_held_against_their_plans(tmp_path):
    """By the process that takes most. Records of other programs hold no plan, and the third run does not know its peak,
    because its process had taken as much before."""
    request = {"config": {"request": {"scheduler": None}}}
    runs = (
        ("one", (200.0, 900.0), 1000.0), ("deep/two", (100.0, 1300.0, 200.0), 1000.0), ("three", (700.0, 700.0), 100.0)
    )  # fmt: skip
    for name, peaks_mb, plan_mb in runs:
        (tmp_path / name).mkdir(parents=True)
        stages = [{"name": "match", "peak_mb": peak} for peak in peaks_mb]
        record = request | {"stages": stages, "plan": {"process_mb": plan_mb, "memory_mb": 3000.0}}
        (tmp_path / name / "run.json").write_text(json.dumps(record))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "run.json").write_text(json.dumps({"stages": []}))
    least, largest = resources.peaks_by_plan(tmp_path)
    assert (least.value, least.passes) == (0.9, True)
    assert (largest.value, largest.passes) == (1.3, False)
    assert resources.peaks_by_plan(tmp_path / "other") == []


def test_a_row_that_cannot_be_run_says_why(monkeypatch, capsys):
    monkeypatch.delenv("ZLOCUS_TEST_DATA", raising=False)
    assert run_script(monkeypatch, acceptance, "city") == 1
    assert "city       cannot be run: ZLOCUS_TEST_DATA is not set" in capsys.readouterr().out
    monkeypatch.setattr(rendered, "city", lambda at: 1 / 0)
    assert run_script(monkeypatch, acceptance, "city") == 1
    assert "ZeroDivisionError" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        run_script(monkeypatch, acceptance, "town")
    assert "no row town; there are fresh-city, fresh-hills, " in capsys.readouterr().err


def test_the_rows_of_other_programs_are_those_of_their_last_run(monkeypatch, capsys, tmp_path):
    """Ratios of the figures that results.json holds, here for the first judged scene and by hand."""
    assert run_script(monkeypatch, acceptance, "peers") == 0
    figures = table_of(capsys.readouterr().out)
    found = json.loads(other_programs.RESULTS.read_text(encoding="utf-8"))
    scene = next(name for name, about in found["scenes"].items() if about["truth"])
    rows = {row["program"]: row for row in found["surfaces"] if row["scene"] == scene and "failed" not in row}
    own = rows["zlocus"]
    others = [row["classes"]["all"]["within"] for name, row in rows.items() if name != "zlocus"]
    within = own["classes"]["all"]["within"] / max(others)
    assert float(figures[f"{scene}, within 1 m over the next"][0]) == pytest.approx(within, rel=1e-3)
    cpu = rows["CARS"]["cpu_s"] / own["cpu_s"]
    assert float(figures[f"{scene}, CPU of CARS over ours"][0]) == pytest.approx(cpu, rel=1e-3)
    monkeypatch.setattr(other_programs, "RESULTS", tmp_path / "results.json")
    # Where CARS failed there is no ratio of costs; where it never ran, there is no row.
    rows["CARS"]["failed"] = "out of memory"
    other_programs.RESULTS.write_text(json.dumps(found), encoding="utf-8")
    labels = [figure.what for figure in other_programs.peers(Workplace(None, tmp_path))]
    assert f"{scene}, CPU of CARS over ours" not in labels
    assert f"{scene}, runs in which CARS failed" in labels
    found["surfaces"].remove(rows["CARS"])
    other_programs.RESULTS.write_text(json.dumps(found), encoding="utf-8")
    with pytest.raises(CannotRun, match=f"no run of CARS on {scene}"):
        other_programs.peers(Workplace(None, tmp_path))
    other_programs.RESULTS.unlink()
    with pytest.raises(CannotRun, match="is not there: run `make peers`"):
        other_programs.peers(Workplace(None, tmp_path))


def test_figures_are_held_against_their_bars():
    assert Figure("a", 0.5).cells() == ("a", "0.5", "", "")
    assert Figure("a", 0.5, "m", at_least=0.5).cells() == ("a", "0.5 m", ">= 0.5 m", "pass")
    assert Figure("a", 0.51, "m", at_most=0.5).cells()[3] == "SHORT"
    assert Figure("a", 0.0, at_least=-0.1, at_most=0.1).cells() == ("a", "0", "-0.1 to 0.1", "pass")
    assert Figure("a", float("nan"), at_most=1).cells()[3] == "SHORT"


def test_a_command_is_measured_and_its_failure_told(tmp_path):
    burn = "import time; held = bytearray(150 * 2**20); until = time.process_time() + 0.3\n"
    burn += "while time.process_time() < until: pass"
    used = workplace.run([sys.executable, "-c", burn])
    assert 0.3 < used.cpu_s < 2
    assert 0.14 < used.peak_gb < 0.4
    with pytest.raises(CannotRun, match="exits 4: no such image"):
        workplace.run([sys.executable, "-c", "import sys; print('no such image', file=sys.stderr); sys.exit(4)"])
    workplace.run([sys.executable, "-c", "raise SystemExit(3)"], accept=(0, 3))
    with pytest.raises(CannotRun, match=f"{tmp_path}/town is missing"):
        Workplace(tmp_path, tmp_path).scene("town")


def test_what_keeps_a_script_from_running_is_one_sentence(capsys):
    def main():
        raise CannotRun("There is no scene.")

    with pytest.raises(SystemExit, match=r"^Error: There is no scene\.$"):
        workplace.ended(main)


@contextmanager
def registry(pages: dict[str, object]) -> Iterator[str]:
    """The address of a package registry that knows these pages."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            page = pages.get(self.path)
            self.send_response(404 if page is None else 200)
            self.end_headers()
            self.wfile.write(json.dumps(page).encode())

        def log_message(self, *_):
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        serving = threading.Thread(target=server.serve_forever)
        serving.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/pypi/"
        finally:
            server.shutdown()
            serving.join()


def installed(name: str, at: str) -> SimpleNamespace:
    return SimpleNamespace(metadata={"Name": name}, version=at)


def test_known_vulnerabilities_are_found(monkeypatch, capsys):
    """Of the version installed; one that is mended or withdrawn is none, and what is unknown is told."""
    known = {"id": "X-1", "summary": "it bites", "fixed_in": ["2.0"]}
    pages = {
        "/pypi/bad/1.0/json": {"info": {"version": "1.0"}, "vulnerabilities": [known, known | {"withdrawn": "now"}]},
        "/pypi/good/json": {"info": {"version": "3.0"}, "vulnerabilities": []},
        "/pypi/newer/json": {"info": {"version": "5.0"}, "vulnerabilities": []},
    }
    here = [installed("bad", "1.0"), installed("good", "3.0"), installed("newer", "4.0"), installed("zlocus", "1")]
    monkeypatch.setattr(audit, "distributions", lambda: here)
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with registry(pages) as address:
        assert run_script(monkeypatch, audit, "--registry", address) == 1
        printed = capsys.readouterr().out
        assert printed.splitlines() == [
            "bad 1.0",
            "    X-1: it bites (mended in 2.0)",
            "The registry says nothing of: newer 4.0",
            "2 of 3 versions looked up, 1 with known vulnerabilities.",
        ]
        here.pop(0)
        assert run_script(monkeypatch, audit, "--registry", address) == 0
    assert "1 of 2 versions looked up, 0 with known" in capsys.readouterr().out


def test_all_that_is_installed_is_asked_for(monkeypatch):
    names = {d.metadata["Name"].lower(): d.version for d in audit.distributions()}
    assert names["numpy"] == version("numpy")


# Metres by which a planted shift of analytic ground may be missed.
SHIFT_TOLERANCE_M = {"rolling, exact": 0.01, "rolling, noise, gross errors, holes": 0.05}


@pytest.fixture
def analytic_cases(monkeypatch):
    monkeypatch.delenv("ZLOCUS_TEST_DATA", raising=False)
    cases = list(coregistration.cases())
    assert [case.name for case in cases] == list(SHIFT_TOLERANCE_M)
    return cases


def test_planted_shifts_are_found(analytic_cases, tmp_path):
    for case in analytic_cases:
        for name, z in (("surface", case.surface), ("reference", case.reference)):
            coregistration.write(tmp_path / f"{name}.tif", z, case.cell_m)
        found = coregistration.evaluated(tmp_path / "surface.tif", tmp_path / "reference.tif", case.cell_m)
        np.testing.assert_allclose(found, case.planted, rtol=0, atol=SHIFT_TOLERANCE_M[case.name], err_msg=case.name)


def test_heights_are_moved_where_they_should_be():
    """Laid beside themselves, by cubic splines, analytic heights are those of the moved place."""
    x, y = np.meshgrid((np.arange(80) + 0.5) * 0.5, (np.arange(80) + 0.5) * 0.5)
    moved = coregistration.moved(coregistration.rolling(x, y), 0.5, (0.8, 1.3, -2.0))
    expected = coregistration.rolling(x - 0.8, y + 1.3) - 2.0
    np.testing.assert_allclose(moved[8:-8, 8:-8], expected[8:-8, 8:-8], rtol=0, atol=1e-3)


def test_without_the_other_program_nothing_is_compared(monkeypatch):
    monkeypatch.setattr(coregistration, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match="xdem is not installed, so there is nothing to compare with"):
        run_script(monkeypatch, coregistration)


def test_two_programs_find_the_same_shift(analytic_cases, monkeypatch, capsys):
    pytest.importorskip("xdem", reason="xdem is not installed: shifts are compared with no other program")
    run_script(monkeypatch, coregistration)
    for row, case in zip(printed_table(capsys.readouterr().out), analytic_cases, strict=True):
        planted, ours, theirs = ([float(part) for part in row[name].split(",")] for name in
                                 ("planted", "zlocus", "xdem"))  # fmt: skip
        np.testing.assert_allclose(ours, planted, rtol=0, atol=SHIFT_TOLERANCE_M[case.name])
        np.testing.assert_allclose(theirs, planted, rtol=0, atol=0.2)


def test_the_benchmark_of_rectified_photographs(tmp_path, monkeypatch, capsys):
    write_photographs(tmp_path / "teddy")
    run_script(monkeypatch, middlebury, tmp_path, "--only", "teddy, 2 views", "--keep", tmp_path / "kept")
    (row,) = printed_table(capsys.readouterr().out)
    assert row["scene"] == "teddy, 2 views"
    ours, opencv, gaps = (float(row[name].rstrip(" %")) for name in ("zlocus", "OpenCV SGBM HH", "gaps before filling"))
    assert 0 <= ours < 8
    assert 0 <= opencv < 20
    assert 0 <= gaps < 30
    # What the other image's truth does not confirm is not judged: cells beside the nearer box, and beyond the border.
    truth = middlebury.true_disparity(tmp_path / "teddy", middlebury.CASES["teddy, 2 views"])
    assert (np.nanmin(truth), np.nanmax(truth)) == DISPARITY_PX
    assert np.isnan(truth[:, : DISPARITY_PX[0]]).all()
    assert 5 < 100 * np.isnan(truth).mean() < 20
    assert middlebury.bad(truth, truth) == 0
    assert middlebury.bad(truth + 2, truth) == 100
    assert middlebury.bad(np.full_like(truth, np.nan), truth) == 100


GROUND_M, TOWER_M, TOWER = 0.0, 15.0, np.s_[24:36, 24:36]


class Photograph:
    """What a frame camera sees of textured ground with a tower, as a view of a scene."""

    def __init__(self, name: str, centre: tuple[float, float, float], texture: np.ndarray, z: np.ndarray) -> None:
        looks_down = np.diag([1.0, -1.0, -1.0])
        self.name, self.sensor = name, FrameModel(centre, looks_down, 60.0, (59.5, 59.5))
        row, col = np.mgrid[: z.shape[0] * 4, : z.shape[1] * 4] / 4.0
        at = row.astype(int), col.astype(int)
        xyz = np.column_stack([col.ravel(), -row.ravel(), z[at].ravel()])
        xy = self.sensor.image_from_ground(xyz)
        # The nearest point to the camera comes last, and stays.
        order = np.argsort(xyz[:, 2], kind="stable")
        pixels = np.zeros((120, 120), np.float32)
        px = np.rint(xy[order]).astype(int)
        inside = ((px >= 0) & (px < 120)).all(axis=1)
        values = cv2.resize(texture, None, fx=4, fy=4, interpolation=cv2.INTER_LINEAR).ravel()
        pixels[px[inside, 1], px[inside, 0]] = values[order][inside]
        window = SimpleNamespace(pixels=pixels, valid=np.ones(pixels.shape, bool))
        self.image = SimpleNamespace(shape=pixels.shape, read=lambda *_: window)


@pytest.fixture(scope="module")
def tower() -> tuple[reprojection.Surface, list[Photograph]]:
    """Ground of 60 m with a tower, cells of a metre, and four photographs from 60 m above it."""
    z = np.full((60, 60), GROUND_M)
    z[TOWER] = TOWER_M
    texture = cv2.GaussianBlur(np.random.default_rng(6).normal(100, 60, (60, 60)).astype(np.float32), (3, 3), 0)
    col, row = np.meshgrid(np.arange(60.0), np.arange(60.0))
    surface = reprojection.Surface(np.dstack([col, -row, z]), 1.0)
    stations = {"a": (22.0, -30.0, 60.0), "b": (38.0, -30.0, 60.0), "c": (30.0, -20.0, 60.0), "d": (30.0, -55.0, 60.0)}
    return surface, [Photograph(name, centre, texture, z) for name, centre in stations.items()]


def test_images_left_out_confirm_a_surface(tower):
    """Correlations are high with the true heights, and lower with others; every cell is counted once."""
    surface, (*matched, left_out) = tower
    (found,) = reprojection.reprojected(surface, matched, [left_out]).values()
    (moved,) = reprojection.reprojected(surface, matched, [left_out], by_m=3.0).values()
    assert found.median > 0.85
    assert moved.median < found.median - 0.2
    told = len(found.ncc) + found.empty + found.outside + found.hidden + found.untextured + found.at_rim
    assert told == found.cells == 3600
    assert found.hidden > 0
    nothing = reprojection.Surface(surface.xyz + np.array([0, 0, np.nan]), 1.0)
    (empty,) = reprojection.reprojected(nothing, matched, [left_out]).values()
    assert (empty.empty, empty.with_height) == (3600, 0)
    assert np.isnan(empty.median)


def plainly_clear(z: np.ndarray, sight: np.ndarray, top: float, margin: float) -> np.ndarray:
    """The kernel's question by a plain loop: every step of the ray along its longer side, nothing passed over."""
    out = np.zeros(z.shape, bool)
    for row, col in np.ndindex(z.shape):
        by = np.array([*sight[row, col].astype(float), 1.0])
        longer = np.abs(by[:2]).max()
        n = int((top - float(z[row, col])) * longer)
        along = [np.array([col, row, z[row, col]]) + by / longer * step for step in range(1, n + 1)]
        on = [(int(np.rint(p[1])), int(np.rint(p[0])), p[2]) for p in along]
        out[row, col] = all(z[r, c] <= ray + margin for r, c, ray in on if 0 <= r < z.shape[0] and 0 <= c < z.shape[1])
    return out


def test_what_a_tower_hides_is_found_as_a_plain_loop_finds_it(tower):
    surface, views = tower
    z = surface.xyz[..., 2].astype(np.float32)
    for view in views:
        x, y, height = view.sensor.centre
        out = np.empty(z.shape, bool)
        col, row = np.meshgrid(np.arange(60.0), np.arange(60.0))
        sight = (np.dstack([x - col, -y - row]) / (height - z)[..., None]).astype(np.float32)
        reprojection.clear_cells(z, reprojection.highest_of(z), sight, height, reprojection.CLEAR_CELLS, out)
        expected = plainly_clear(z, sight, height, reprojection.CLEAR_CELLS)
        # Squares of 2 x 2 cells are hidden together.
        alike = expected[::2, ::2].repeat(2, axis=0).repeat(2, axis=1)
        np.testing.assert_array_equal(out, alike)
    assert not expected.all()


def test_windows_are_correlated_over_what_both_images_show():
    rng = np.random.default_rng(1)
    a, usable = rng.normal(size=(30, 30)), np.ones((30, 30), bool)
    np.testing.assert_allclose(reprojection.window_ncc(a, 3 * a + 5, usable)[8:-8, 8:-8], 1, atol=1e-6)
    np.testing.assert_allclose(reprojection.window_ncc(a, -a, usable)[8:-8, 8:-8], -1, atol=1e-6)
    spoilt = np.where(np.arange(30) < 12, 100 * a, a)
    usable[:, :12] = False
    np.testing.assert_allclose(reprojection.window_ncc(a, spoilt, usable)[8:-8, 14:-8], 1, atol=1e-6)
    np.testing.assert_array_equal(reprojection.window_ncc(a, np.ones((30, 30)), usable), 0)
