"""Benchmarks that judge surfaces, each run on a small rendered town: their tables and figures are plausible."""

from __future__ import annotations

import csv
import importlib.util
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

import baselines
import double_mapping
import judging
import precision
import selection
import spaces
import terrain
import terrain_features
from benchmark_scripts import printed_table, run_script, share_of
from rows import flags, standard_deviations
from workplace import CannotRun
from zlocus.io.scene_file import open_scene
from zlocus.matching import precision_calibration as calibration
from zlocus.matching import tile
from zlocus.matching.quality import Quality

# Share of the cells of the small town within 1 m of the truth. Methods reach .87 and more; much less is a fault of a
# benchmark.
LEAST_WITHIN = 0.8
# Shares of the errors within one and two standard deviations that are asked for, and how far they may be off on a town
# as small as this, with a calibration that was made elsewhere.
ONE_SIGMA, TWO_SIGMA, SIGMA_TOLERANCE = 0.68, 0.94, 0.12
ROUNDED = 6e-4  # of a share that is printed in tenths of a per cent


@pytest.fixture(autouse=True)
def own_judge(monkeypatch, tmp_path):
    """Figures do not depend on whether the shared judge is at hand."""
    monkeypatch.setattr(judging, "JUDGE", tmp_path / "no-judge.py")


def csv_rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_benchmark_of_the_choice_of_views(small_town, tmp_path, monkeypatch, capsys):
    chosen = ("all images", "3 best by geometry", "guided")
    run_script(monkeypatch, selection, small_town, "-o", tmp_path, "--curves", 300, "--only", *chosen)
    rows = {row["choice"]: row for row in printed_table(capsys.readouterr().out)}
    assert tuple(rows) == chosen
    every, three, guided = csv_rows(tmp_path / "selection.csv")
    assert [row["images"] for row in (every, three, guided)] == ["8", "3", "8"]
    for row in (every, three, guided):
        assert LEAST_WITHIN < float(row["within_all"]) <= 1
        assert abs(share_of(rows[row["choice"]]["within 1 m"]) - float(row["within_all"])) < ROUNDED
        assert 0.5 < float(row["rho1"]) <= 1 < float(row["ratio"])
        assert 0 < float(row["good"]) <= 1
    # All eight views are compared wherever they see a cell; the guided choice spares a part of that.
    assert float(every["share"]) > 0.99
    assert float(guided["share"]) < 0.9
    assert float(three["evaluations"]) < float(guided["evaluations"]) < float(every["evaluations"])
    assert 2 <= float(three["views_used"]) <= 3 < float(guided["views_used"]) < float(every["views_used"]) <= 8
    assert (tmp_path / "selection.png").stat().st_size > 0


def test_views_are_ranked_by_geometry_from_the_most_nadir_on(small_town):
    """The first looks 4 degrees from the nadir. Of the others, rays meet its own at 19 and 21, 16, 26, 28, 14 and 12
    degrees, of which those nearest to 20 are the best, by the smaller angle over the larger."""
    views = json.loads((small_town / "scene.json").read_text())["views"]
    images = {name: small_town / f"img_{name}.tif" for name in views}
    found = selection.ranked_by_geometry(images, "EPSG:32632", 440.0)
    assert (found[0], set(found[1:3]), found[3:]) == ("n1", {"f1", "b1"}, ["n2", "f2", "b2", "d2", "d1"])


def test_a_choice_that_does_not_exist_is_named(small_town, tmp_path, monkeypatch):
    with pytest.raises(CannotRun, match="no choice `all`: --only takes `all images`, "):
        run_script(monkeypatch, selection, small_town, "-o", tmp_path, "--only", "all")


@pytest.mark.parametrize("script", [selection, spaces, terrain, baselines], ids=lambda script: script.__name__)
def test_a_folder_without_a_truth_is_named(script, tmp_path, monkeypatch):
    with pytest.raises(CannotRun, match=f"`{tmp_path}` holds no truth_dsm.tif: name the folder of a rendered scene"):
        run_script(monkeypatch, script, tmp_path)


def test_a_run_that_fails_ends_the_benchmark(small_town, tmp_path, monkeypatch):
    """Whatever goes wrong in a run, the benchmark says it instead of going on without a surface."""

    def fails(*_):
        raise TypeError("planted")

    monkeypatch.setattr(tile, "cost_volume", fails)
    with pytest.raises(CannotRun, match="`zlocus dsm` ends with status 3"):
        run_script(monkeypatch, selection, small_town, "-o", tmp_path, "--only", "3 best by geometry")


def test_the_benchmark_of_object_and_image_space(small_town, tmp_path, monkeypatch, capsys):
    run_script(monkeypatch, spaces, small_town, "-o", tmp_path, "--views", "3")
    printed = capsys.readouterr().out
    rows = {row["matched in"]: row for row in printed_table(printed)}
    assert list(rows) == ["object space", "image space", "nadir only"]
    for row in rows.values():
        assert (row["scene"], row["views"]) == (small_town.name, "3")
        assert LEAST_WITHIN < share_of(row["all"]) <= share_of(row["complete"]) <= 1
        # Open ground is easier than edges, and the classes are those of the town.
        assert share_of(row["edges"]) < share_of(row["open"])
        assert 0 < share_of(row["tree"]) < share_of(row["ground"]) <= 1
        assert 0 < float(row["NMAD ground, m"]) < 0.25 < float(row["RMSE, m"])
        assert share_of(row["1 sigma"]) < share_of(row["2 sigma"]) <= 1
    # Views beside the nadir add heights.
    assert share_of(rows["nadir only"]["complete"]) < share_of(rows["image space"]["complete"])
    # Every block is in one of the four places.
    places = dict(re.findall(r"'(\w+)': '([\d.]+)%'", printed.splitlines()[-1]))
    assert abs(sum(float(places[name]) for name in spaces.PLACES) - 100) < 0.25
    assert [row["method"] for row in csv_rows(tmp_path / "spaces.csv")] == list(rows)
    assert (tmp_path / "spaces.png").stat().st_size > 0


def sigmas(line: str) -> tuple[float, float]:
    """Shares of all errors within one and two standard deviations, of a line that `judgement` made."""
    one, two = re.search(r"views: all ([\d.]+)/([\d.]+);", line).groups()
    return float(one), float(two)


def test_standard_deviations_are_calibrated(small_town, tmp_path, monkeypatch, capsys):
    """The module that is written has the curves of the one in use, and fits what it was made from."""
    before, written = Path(calibration.__file__).read_bytes(), tmp_path / "calibration.py"
    asked = ["--views", 6, 2, "--calibration", written, "--fewest", 1000, "-o", tmp_path]
    run_script(monkeypatch, precision, "fit", small_town, *asked)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" views")[0] for line in lines] == ["small-town, 6", "small-town, 2"]
    for line in lines:
        one, two = sigmas(line)
        assert abs(one - ONE_SIGMA) < SIGMA_TOLERANCE / 2
        assert abs(two - TWO_SIGMA) < SIGMA_TOLERANCE / 2
    spec = importlib.util.spec_from_file_location("written_calibration", written)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name in ("SPLIT", "PAIR"):
        (*constants, curves), (*_, known) = getattr(module, name), getattr(calibration, name)
        assert curves.keys() == known.keys()
        assert np.isfinite(constants).all()
        # What may only raise the standard deviation does.
        rising = ("noise", "roughness", "refinement", "distance")
        assert all(np.diff(curves[predictor][2]).min() >= 0 for predictor in rising)
    assert Path(calibration.__file__).read_bytes() == before


def test_too_few_cells_for_a_calibration_are_told(small_town, tmp_path, monkeypatch):
    asked = ["--views", 2, "--calibration", tmp_path / "calibration.py", "-o", tmp_path]
    with pytest.raises(CannotRun, match="No run has 5000 cells of known error seen by more than a pair of images"):
        run_script(monkeypatch, precision, "fit", small_town, *asked)
    assert not (tmp_path / "calibration.py").exists()


def test_standard_deviations_are_judged(small_town, tmp_path, monkeypatch, capsys):
    run_script(monkeypatch, precision, "judge", small_town, "--views", 3, "-o", tmp_path)
    (line,) = capsys.readouterr().out.splitlines()
    one, two = sigmas(line)
    assert abs(one - ONE_SIGMA) < SIGMA_TOLERANCE
    assert abs(two - TWO_SIGMA) < SIGMA_TOLERANCE
    assert (tmp_path / "calibration.png").stat().st_size > 0


def test_shares_within_sigma_by_recipe():
    """Errors of 0.5, 1.5 and 2.5 sigma on 62, 30 and 8 of 100 cells; trees, all wrong by 5 sigma, do not count."""
    planted = np.repeat([0.5, 1.5, 2.5, 5.0], (62, 30, 8, 100))
    sigma = np.linspace(0.1, 0.5, 200)
    judged = precision.Judged(planted * sigma, sigma, np.repeat([0, 1, 2], (50, 50, 100)))
    one, two = standard_deviations.of_recipes({("hills", 3): [judged]})
    assert (one.value, two.value) == (0.62, 0.92)
    assert one.passes
    assert two.passes
    figures = {figure.what: figure.value for figure in standard_deviations.of_all_cells([judged])}
    assert figures["within two sigma, most of the scenes"] == 0.46
    # The tenth with the largest sigma is all trees, wrong by more than 1 m; so are all trees with sigma above 0.2 m.
    is_large = np.abs(judged.error_m) > 1
    expected = 20 / is_large.sum()
    assert figures["errors above 1 m in the tenth with the largest sigma, least"] == expected < 1


def test_what_a_warning_is_worth_is_counted(small_town, small_surface):
    """Of 1000 heights, 200 are wrong; JUMP marks 150 of these and 100 right ones; water has no warning."""
    error, quality = np.repeat([0.5, 3.0], (800, 200)), np.zeros(1000, np.uint16)
    quality[700:950] = Quality.JUMP
    quality[:300] = Quality.WATER
    sigma = np.repeat([0.1, 1.0, 4.0], (100, 800, 100))
    made_up = flags.FlaggedHeights(error, sigma, quality)
    found = {figure.what: figure.value for figure in flags.figures_of("hills", [made_up, made_up])}
    assert found["hills, wrong heights"] == 0.2
    assert found["hills, heights off by more than 3 sigma"] == 0.1
    assert found["hills, JUMP: marked, wrong"] == 0.6
    assert found["hills, JUMP: of the wrong heights"] == 0.75
    assert found["hills, JUMP: of the right heights"] == 0.125
    assert "hills, PLANE: marked, wrong" not in found
    assert found["hills, sigma below two cells: right heights kept"] == 1.0
    assert found["hills, sigma below two cells: wrong heights among the kept"] == pytest.approx(100 / 900)

    _, xy, errors = precision.errors_of(small_town, small_surface / "dsm.tif")
    real = flags.flagged(small_surface, xy, errors)
    assert len(real.quality) == np.isfinite(errors).sum()
    with rasterio.open(small_surface / "quality.tif") as file:
        k = int(np.flatnonzero(np.isfinite(errors))[0])
        assert real.quality[0] == next(file.sample([xy[k]]))[0]


def terrain_rows(text: str) -> dict[str, list[float]]:
    """Figures of a class: cells; shares with a height and within 1 m; median and NMAD, m; within 1 m before."""
    rows = re.findall(r"^(ground|building|tree) (.*)$", text, re.MULTILINE)
    return {name: [float(number) for number in re.findall(r"-?[\d.]+", figures)] for name, figures in rows}


def test_the_benchmark_of_the_terrain(small_town, small_surface, monkeypatch, capsys):
    """Below roofs and trees of the true surface the ground is found; of a matched one too, a little less."""
    run_script(monkeypatch, terrain, small_town)
    exact = terrain_rows(capsys.readouterr().out)
    run_script(monkeypatch, terrain, small_town, small_surface)
    matched = terrain_rows(capsys.readouterr().out)
    n = {name: int(row[0]) for name, row in exact.items()}
    assert sum(n.values()) == 224**2  # cells of the truth
    assert sum(int(row[0]) for row in matched.values()) == 112**2  # cells of the surface
    for name in ("building", "tree"):
        assert exact[name][-1] < 5  # nothing of it is ground before
        assert exact[name][2] > 80
        assert matched[name][2] > 50
    assert exact["ground"][2] > 90
    assert matched["ground"][2] > 85
    assert exact["ground"][4] < 0.05 < matched["ground"][4] < 0.25


def test_the_benchmark_of_terrain_features(tmp_path, monkeypatch, capsys):
    run_script(monkeypatch, terrain_features, "-o", tmp_path, "--only", "similar", "--views", 2, "--size", 80)
    printed = capsys.readouterr().out
    assert re.match(r"similar: [3-6]\d% of the cells show it\n", printed)
    rows = {(row["method"], row["matched at"].split()[0]): row for row in printed_table(printed)}
    assert list(rows) == [(method, levels) for method in ("MVLL", "MVLL + SGM") for levels in ("one", "many")]
    for levels in ("one", "many"):
        alone, joined = rows["MVLL", levels], rows["MVLL + SGM", levels]
        # Rows of crops repeat: without the semi-global constraint heights are found a period away.
        assert share_of(alone["within 1 m"]) + 0.05 < share_of(joined["within 1 m"]) <= 1
        assert share_of(joined["within 0.5 m"]) <= share_of(joined["within 1 m"])
        assert float(joined["RMSE, m"]) < float(alone["RMSE, m"])
    many, one = (int(rows["MVLL + SGM", levels]["evaluations, M"]) for levels in ("many", "one"))
    assert many < one
    assert len(csv_rows(tmp_path / "features.csv")) == 4
    assert all((tmp_path / name).stat().st_size > 0 for name in ("similar.png", "features.png"))


def test_the_benchmark_of_other_methods(small_town, tmp_path, monkeypatch, capsys):
    run_script(monkeypatch, baselines, small_town, "--keep", tmp_path)
    rows = {row["method"]: row for row in printed_table(capsys.readouterr().out)}
    assert list(rows) == ["mvll", "opencv"]
    for method, row in rows.items():
        assert LEAST_WITHIN < float(row["all"]) < 1
        assert float(row["tree"]) < float(row["ground"])
        assert 0.05 < float(row["NMAD ground, m"]) < 0.6
        with rasterio.open(tmp_path / small_town.name / method / "dsm.tif") as file:
            assert file.shape == (112, 112)


def test_a_pointing_error_is_undone_for_other_methods(small_town, tmp_path):
    """Corrections are those of a run, or else what undoes the errors that were rendered."""
    scene = baselines.open_rendered(small_town)
    text = json.loads((small_town / "scene.json").read_text())
    text["views"]["f1"]["bias_row_col"] = [1.5, -0.5]
    (tmp_path / "scene.json").write_text(json.dumps(text))
    planted = baselines.pointing(replace(scene, folder=tmp_path), None)
    np.testing.assert_array_equal(planted["f1"], [0.5, -1.5])
    record = {"orientation": {"views": {f"img_{name}": {"shift_px": [0.25, 2.0]} for name in baselines.PAIR}}}
    (tmp_path / "run.json").write_text(json.dumps(record))
    np.testing.assert_array_equal(baselines.pointing(scene, tmp_path / "run.json")["n1"], [0.25, 2.0])


def test_cells_that_show_what_hides_them(small_town, small_surface):
    """Few, as in the town of the acceptance table; and most of them once another image is shown everywhere."""
    views = open_scene([small_town / f"img_{name}.tif" for name in ("n1", "f1", "b1", "n2", "f2", "b2")])
    truth = small_town / "truth_dsm.tif", small_town / "truth_class.tif"
    found = double_mapping.double_mapped(small_surface, *truth, views)
    assert found.keys() == {"ground", "building", "tree"}
    assert found["ground"][0] < 0.02
    assert all(0 <= right <= 1 for shares in found.values() for right in shares)


def test_a_judge_that_names_the_shift_that_it_removed(tmp_path, monkeypatch):
    """The shift is no class of the ground, and stands among the classes in the judge's answer."""
    script = tmp_path / "judge.py"
    answer = {"shift": [0.5, -0.5, 0.1], "all": {"complete": 0.9, "within": 0.8}}
    script.write_text(f"print({json.dumps(json.dumps(answer))})\n")
    monkeypatch.setattr(judging, "JUDGE", script)
    found = judging.judged(Path("a.tif"), Path("b.tif"), Path("c.tif"), align=True)
    assert found == {"all": {"complete": 0.9, "within": 0.8, "completeness": 0.9}}
