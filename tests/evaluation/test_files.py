"""`zlocus evaluate` as a command: what it prints, and the figures, map and histogram that it leaves in a folder."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from rio_cogeo import cog_validate
from typer.testing import CliRunner

from evaluation_rasters import NORTH, WEST, moved, rolling, write
from places import ROOT
from point_files import cloud
from point_scenes import table
from zlocus.cli import evaluate as command
from zlocus.cli.app import app
from zlocus.evaluation import files
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.histogram import histogram_figure
from zlocus.evaluation.slopes import SLOPE_EDGES_DEG
from zlocus.io.styles.file_names import style_files

N = 120
PAGE = ROOT / "docs" / "how-to" / "evaluate.md"


@pytest.fixture
def pair(tmp_path):
    """A surface 0.5 m too high in the west, without heights in the south, and its reference."""

    def spoiled(z):
        z = z + np.where(np.arange(N) < N // 2, 0.5, 0.0)
        z[90:] = np.nan
        return z

    return moved(tmp_path / "dsm.tif", N, (0, 0, 0), change=spoiled), moved(tmp_path / "reference.tif", N, (0, 0, 0))


def run(*arguments):
    return CliRunner().invoke(app, ["evaluate", *map(str, arguments)])


def test_the_folder_holds_figures_map_and_histogram(tmp_path, pair):
    out = tmp_path / "deep" / "out"
    result = run(*pair, "--margin", 0, "-o", out, "--json", "--threshold", 0.3, "--threshold", 1)
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in out.iterdir()) == sorted([*files.NAMES, *style_files(files.ERROR_MAP)])
    printed, kept = json.loads(result.stdout), json.loads((out / "evaluation.json").read_text())
    of_all = ("command", "version", "exit_status", "out", "files")  # entries of every command
    assert kept == {"schema": 2} | {name: value for name, value in printed.items() if name not in of_all}
    assert printed["all"]["within_m"] == {"0.3": 0.375, "1": 0.75}
    assert printed["all"]["within"] == 0.375
    assert printed["all"]["completeness"] == 0.75


def test_the_map_has_the_errors_where_they_are(tmp_path, pair):
    run(*pair, "--margin", 10, "-o", tmp_path / "out")
    assert cog_validate(tmp_path / "out" / "error.tif")[0]
    with rasterio.open(tmp_path / "out" / "error.tif") as source:
        errors = source.read(1)
        assert (source.shape, source.crs.to_epsg(), source.units) == ((N, N), 32632, ("m",))
        assert source.transform == from_origin(WEST, NORTH, 0.5, 0.5)
        assert np.isnan(source.nodata)
        assert errors.dtype == np.float32
    inner = errors[20:90, 20:-20]
    np.testing.assert_allclose(inner[:, :40], 0.5, atol=1e-4)
    np.testing.assert_allclose(inner[:, 40:], 0, atol=1e-4)
    # The rim is not judged, and what is missing has no error.
    assert np.isfinite(errors).sum() == inner.size


def test_the_map_of_blocks_lies_on_blocks(tmp_path):
    # Blocks of 5 x 5 cells of 0.1 m, of which the last three rows and columns are none; higher in the second block.
    quarter = from_origin(WEST, NORTH, 0.1, 0.1)
    reference = write(tmp_path / "r.tif", np.zeros((13, 13), np.float32), quarter)
    dsm = np.zeros((13, 13), np.float32)
    dsm[:5, 5:10] = 0.25
    errors = evaluate(write(tmp_path / "d.tif", dsm, quarter), Comparison(reference, margin_m=0)).error_map
    np.testing.assert_array_equal(errors.errors, np.array([[0, 0.25], [0, 0]], np.float32))
    assert errors.geobox.transform.a == pytest.approx(0.5)
    assert errors.geobox.shape == (2, 2)


def test_the_histogram_shows_the_errors(tmp_path, pair):
    run(*pair, "--margin", 0, "-o", tmp_path / "out")
    picture = cv2.imread(str(tmp_path / "out" / "histogram.png"))
    assert picture.shape == (540, 900, 3)
    result = evaluate(pair[0], Comparison(pair[1], margin_m=0))
    axes = histogram_figure(result).axes[0]
    (bars,) = (patch for patch in axes.patches if hasattr(patch, "get_data"))
    values, edges, _ = bars.get_data()
    at = (edges[1:] + edges[:-1]) / 2
    assert values.sum() == pytest.approx(100)
    assert values[np.abs(at) < 0.02].sum() == pytest.approx(50)
    assert values[np.abs(at - 0.5) < 0.02].sum() == pytest.approx(50)
    assert axes.get_title(loc="left").startswith("75.0 % of 14400 cells have a height")


@pytest.mark.parametrize(("threshold_m", "limits"), [(0.3, [-0.3, 0.3]), (5.0, [])])
def test_the_histogram_has_limits_where_they_lie_inside(pair, threshold_m, limits):
    """Errors of 0 and 0.5 m: LE95 is 0.5 m, of which 1.25 times is shown."""
    axes = histogram_figure(evaluate(pair[0], Comparison(pair[1], margin_m=0, threshold_m=threshold_m))).axes[0]
    assert axes.get_xlim() == pytest.approx((-0.625, 0.625), abs=1e-4)
    upright = {line.get_label(): line.get_xdata()[0] for line in axes.lines if len(set(line.get_xdata())) == 1}
    assert sorted(x for label, x in upright.items() if not label.startswith("median")) == limits
    said = [text.get_text() for text in axes.get_legend().get_texts()]
    assert ("±0.3 m" in said) == bool(limits)


def test_a_surface_that_is_all_but_complete_is_not_100_percent(tmp_path, pair):
    surface = np.zeros((N, N), np.float32)
    surface[60, 60] = np.nan
    nearly = evaluate(write(tmp_path / "nearly.tif", surface), Comparison(pair[1], margin_m=0))
    assert 0.9995 < nearly.statistics.completeness < 1
    assert histogram_figure(nearly).axes[0].get_title(loc="left").startswith("More than 99.9 % of")


def test_a_histogram_of_nothing_says_so(tmp_path, pair):
    empty = write(tmp_path / "empty.tif", np.full((N, N), np.nan, np.float32))
    figure = histogram_figure(evaluate(empty, Comparison(pair[1])))
    assert [text.get_text() for text in figure.axes[0].texts] == ["no height where the reference has one"]


def test_the_files_are_named(tmp_path, pair):
    said = run(*pair, "-o", tmp_path / "out").stdout.splitlines()[-1]
    assert said == f"{tmp_path / 'out'}: evaluation.json, error.tif, histogram.png written."
    files = json.loads(run(*pair, "-o", tmp_path / "json", "--json").stdout)["files"]
    assert all(Path(file).parent == tmp_path / "json" and Path(file).exists() for file in files)


def test_a_comparison_shows_its_progress(pair):
    assert run(*pair).stderr.startswith("Comparing: done in ")


def test_a_failed_write_leaves_no_part(tmp_path, pair, monkeypatch):
    out = tmp_path / "out"
    assert run(*pair, "-o", out).exit_code == 0

    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", fail)
    result = run(*pair, "-o", out, "--overwrite", "-q")
    assert (result.exit_code, len(result.stderr.splitlines())) == (2, 1)
    assert "histogram.png cannot be written: No space left on device" in result.stderr
    # The figures of the evaluation before are gone: they are not those of the new map.
    left = [*style_files(files.ERROR_MAP), "error.tif", "histogram.png"]
    assert sorted(path.name for path in out.iterdir()) == sorted(left)


def test_another_evaluation_is_replaced_only_on_request(tmp_path, pair):
    out = tmp_path / "out"
    assert run(*pair, "-o", out).exit_code == 0
    before = (out / "evaluation.json").read_bytes()
    result = run(*pair, "-o", out, "--margin", 5)
    assert (result.exit_code, len(result.stderr.splitlines())) == (2, 1)
    assert "out holds another evaluation (evaluation.json, error.tif, histogram.png)" in result.stderr
    assert (out / "evaluation.json").read_bytes() == before
    assert run(*pair, "-o", out, "--margin", 5, "--overwrite").exit_code == 0
    assert (out / "evaluation.json").read_bytes() != before
    # The folder of a run has room for one beside it.
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").touch()
    assert run(*pair, "-o", tmp_path / "run").exit_code == 0


def test_no_input_is_written_over(tmp_path, pair):
    mine = pair[0].rename(tmp_path / "error.tif")
    before = mine.read_bytes()
    result = run(mine, pair[1], "-o", tmp_path)
    assert result.exit_code == 2
    assert "error.tif would be written over" in result.stderr
    assert mine.read_bytes() == before
    file = tmp_path / "file"
    file.touch()
    assert "is a file, and the output must be a folder" in run(*pair[::-1], "-o", file).stderr


def test_the_contract_of_the_command_holds(pair):
    dsm, reference = pair
    table = run(dsm, reference, "--margin", 5).stdout.splitlines()
    assert table[0].split() == ["absolute", "aligned"]
    assert table[1].split() == ["cells", "complete", *["within", "median", "NMAD", "RMSE", "LE90"] * 2]
    assert table[2].split()[:2] == ["all", "10000"]
    assert "within: share of all cells in error by less than 1 m; errors in m" in table
    assert any(line.startswith("aligned: removed first: ") for line in table)
    # The table shows both kinds of figures whether or not the shift is asked for; the last line says what changes.
    asked = run(dsm, reference, "--margin", 5, "--align").stdout.splitlines()
    assert asked[:-1] == table[:-1]
    assert table[-1].endswith("the absolute ones; --align or --coregister makes them the aligned ones")
    assert asked[-1].endswith("the aligned ones, because of --align")
    several = run(dsm, reference, "--threshold", 1, "--threshold", 0.25).stdout.splitlines()
    thresholds = several[several.index("") + 2]
    assert thresholds.split() == ["cells", "complete", *["<", "1", "m", "<", "0.25", "m"] * 2]


def test_both_kinds_of_figures_are_in_every_output(tmp_path):
    dsm, reference = moved(tmp_path / "d.tif", N, (0.7, -1.2, 0.4)), moved(tmp_path / "r.tif", N, (0, 0, 0))
    for options, drawn, other in (((), "absolute", "aligned"), (("--align",), "aligned", "absolute")):
        printed = json.loads(run(dsm, reference, "--json", *options, "-o", tmp_path / "out", "--overwrite").stdout)
        kept = json.loads((tmp_path / "out" / "evaluation.json").read_text())
        for record in (printed, kept):
            assert record["absolute"]["all"]["rmse"] > 0.4 > 10 * record["aligned"]["all"]["rmse"]
            assert record["aligned"]["shift_m"]["north"] == pytest.approx(-1.2, abs=0.03)
            assert record["all"] == record[drawn]["all"]
            assert (record["shift_m"] is None) == (drawn == "absolute")
        with rasterio.open(tmp_path / "out" / "error.tif") as source:
            errors = source.read(1)
        assert float(np.nanmedian(np.abs(errors))) == pytest.approx(printed["mvs3dm_median_error"], abs=0.02)
        result = evaluate(dsm, Comparison(reference, align=bool(options)))
        title = histogram_figure(result).axes[0].get_title(loc="left").splitlines()
        assert title[0].endswith(f"drawn: {drawn} errors")
        figures = printed[other]["all"]
        assert title[1] == f"{other} errors: median {figures['median']:+z.3f} m, NMAD {figures['nmad']:.3f} m"


def test_an_empty_surface_ends_with_a_sentence_and_writes_nothing(tmp_path, pair):
    empty = write(tmp_path / "empty.tif", np.full((N, N), np.nan, np.float32))
    plain, asked = run(empty, pair[1], "-o", tmp_path / "out", "-q"), run(empty, pair[1], "--align")
    assert (plain.exit_code, asked.exit_code, len(asked.stderr.splitlines())) == (2, 2, 1)
    assert plain.stderr == asked.stderr
    assert "empty.tif holds no height at all, so nothing can be compared. See its quality.tif" in asked.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--slopes", "flat"), "--slopes flat is no list of degrees"),
        (("--slopes", "30,10"), "must rise"),
        (("--threshold", "1", "--threshold", "0"), "--threshold 0 is not a size"),
        (("--align", "--coregister", "nuth-kaab"), "both look for the shift"),
        (("--coregister", "icp"), "not known"),
    ],
)
def test_bad_options_are_said_in_one_sentence(pair, options, says):
    result = run(*pair, *options)
    assert (result.exit_code, len(result.stderr.splitlines())) == (2, 1)
    assert says in result.stderr


def test_bands_can_be_chosen_or_left_out(pair):
    assert list(json.loads(run(*pair, "--slopes", "20", "--json").stdout)["slopes_deg"]) == ["0-20", "20-90"]
    assert json.loads(run(*pair, "--slopes", "none", "--json").stdout)["slopes_deg"] == {}
    assert ",".join(f"{edge:g}" for edge in SLOPE_EDGES_DEG) == command.DEFAULT_SLOPES


def test_the_commands_of_the_page_run(tmp_path, pair, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "classes.tif", np.zeros((N, N), np.uint8))
    moved(tmp_path / "moved.tif", N, (1, -1, 2), rolling)
    at = from_origin(8.9, 47.1, 0.05, 0.05)
    write(tmp_path / "geoid.tif", np.full((6, 6), 47.0, np.float32), at, "EPSG:4326")
    points = table(tmp_path, 200, name="check_points.csv")
    xyz = np.loadtxt(points, delimiter=",", skiprows=1)
    cloud(tmp_path / "laser.laz", xyz)
    lines = [line.strip() for line in PAGE.read_text(encoding="utf-8").splitlines()]
    commands = [shlex.split(line, comments=True) for line in lines if line.startswith("zlocus evaluate ")]
    assert len(commands) >= 4
    for words in commands:
        result = CliRunner().invoke(app, words[1:])
        assert result.exit_code == 0, (words, result.output)


def test_the_page_names_every_option_and_figure(pair):
    page = PAGE.read_text(encoding="utf-8")
    from typer.main import get_command

    options = {name for p in get_command(app).commands["evaluate"].params for name in p.opts if name.startswith("--")}
    of_all = {"--help", "--quiet", "--verbose", "--log", "--json"}  # options of every command
    assert all(f"`{name}" in page for name in options - of_all)
    record = evaluate(pair[0], Comparison(pair[1], align=True)).as_dict()
    named = {*record, *record["all"]}
    assert all(f"`{name}`" in page for name in named), [name for name in named if f"`{name}`" not in page]
