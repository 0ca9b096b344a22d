"""`zlocus paper`: every table and figure once, on a small rendered town whose six images are named as the paper's."""

from __future__ import annotations

import csv
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from zlocus.cli.app import app
from zlocus.core.options import SelectionOptions
from zlocus.core.paper_request import PAPER_FILES, POINTS_FILE
from zlocus.io.run_record import write_record
from zlocus.matching.match_curve import curve_peaks, peak_ratio, quality_labels
from zlocus.pipeline import paper
from zlocus.pipeline.demo_block import DIGEST, block_digest
from zlocus.products.printed_values import TABLE_3, TABLE_4

VIEWS = ("n1", "f1", "b1", "n2", "f2", "b2")
OPTIONS = SelectionOptions()
REACH = OPTIONS.reach_steps
# Correlations are written with six decimals in curves, with four in tables.
IN_CURVES, IN_TABLES = 1e-6, 6e-5


def zl(*arguments):
    return CliRunner().invoke(app, ["paper", *map(str, arguments)])


@pytest.fixture(scope="module")
def town(small_town):
    return tuple(small_town / f"img_{name}.tif" for name in VIEWS)


@pytest.fixture(scope="module")
def oriented():
    """The setup of a run, found once for all commands of a space."""
    return {}


@pytest.fixture(autouse=True)
def one_orientation(monkeypatch, oriented):
    """The tie points of the town are found once: the commands differ in what they show only."""
    orient = paper.orient_views

    def once(scene, *rest, **options):
        key = tuple(view.name for view in scene.views)
        if key not in oriented:
            oriented[key] = orient(scene, *rest, **options)
        return oriented[key]

    monkeypatch.setattr(paper, "orient_views", once)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return {space: tmp_path_factory.mktemp("paper") / space for space in ("image", "ground")}


@pytest.fixture(scope="module")
def printed():
    """What the commands without further options have printed, by their folder and name."""
    return {}


@pytest.fixture(scope="module")
def made(town, folders, printed):
    """The folder of a space with the files of a command, and what it prints: `made(space, what, *more)`. A command
    without further options is run once, one with some in a folder of its own."""

    def of(space, what, *more):
        out = folders[space].with_name("asked") if more else folders[space]
        if more or (out, what) not in printed:
            result = zl(what, *town, "-o", out, "--space", space, "--overwrite", *more)
            assert result.exit_code == 0, result.output
            printed[out, what] = result.stdout
        return out, printed[out, what]

    return of


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def curves_of(rows, prefix):
    """(name, curve) of every column of a file of curves that begins with `prefix`."""
    names = [key for key in rows[0] if key.startswith(prefix)]
    return {key.removeprefix(prefix): np.array([float(row[key] or "nan") for row in rows]) for key in names}


@pytest.mark.parametrize("space", ["image", "ground"])
@pytest.mark.parametrize("what", PAPER_FILES)
def test_every_table_and_figure_is_one_command(made, space, what):
    out, text = made(space, what)
    for name in PAPER_FILES[what]:
        assert (out / name).is_file()
    assert "Reference  img_n1" in text
    assert ("ray of the reference image" if space == "image" else "vertical line") in text
    if what.startswith("figure"):
        picture = cv2.imread(str(out / f"{what}.png"))
        assert picture.shape[0] > 200
        assert (picture < 250).mean() > 0.02
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


def test_table_3_holds_what_the_curves_of_the_feature_points_show(made):
    out, _ = made("image", "table3")
    table = rows_of(out / "table3.csv")
    assert [row["point"] for row in table] == [f"P{k}" for k in (1, 2, 3) for _ in range(5)]
    for number, figure in enumerate(("figure3", "figure4", "figure5"), 1):
        made("image", figure)
        curves = curves_of(rows_of(out / f"{figure}.csv"), "ncc_")
        assert all(len(curve) == 2 * REACH + 1 for curve in curves.values())
        for row in table[5 * (number - 1) : 5 * number]:
            rho1 = float(row["rho1"])
            assert np.nanmax(curves[row["image"]]) == pytest.approx(rho1, abs=IN_TABLES)
            if row["rho2"] != "none":
                rho2 = float(row["rho2"])
                assert np.abs(curves[row["image"]] - rho2).min() < IN_TABLES
                ratio = float(row["ratio"])
                assert ratio == pytest.approx(abs(rho1 / rho2), rel=1e-3 + IN_TABLES / abs(rho2))


def test_table_4_sums_the_labels_of_table_3(made):
    out, text = made("image", "table4")
    made("image", "table3")
    sums: dict[str, int] = {}
    for row in rows_of(out / "table3.csv"):
        sums[row["image"]] = sums.get(row["image"], 0) + int(row["label"])
    table = rows_of(out / "table4.csv")
    assert {row["image"]: int(row["accumulated_label"]) for row in table} == sums
    assert [int(row["accumulated_label"]) for row in table] == sorted(sums.values(), reverse=True)
    assert [row["place"] for row in table] == ["1", "2", "3", "4", "5"]
    assert "Printed order: b1, f1; b2; n2, f2." in text


def test_the_printed_values_stand_beside_ours(town, folders):
    """Where the images have the names of the paper's."""
    renamed = []
    for path, name in zip(town, VIEWS, strict=True):
        link = folders["image"].parent / f"{name}.tif"
        if not link.exists():
            link.symlink_to(path)
        renamed.append(link)
    out = folders["image"].parent / "renamed"
    for what in ("table3", "table4"):
        assert zl(what, *renamed, "-o", out, "--overwrite").exit_code == 0
    for row in rows_of(out / "table3.csv"):
        printed = TABLE_3[row["point"], row["image"]]
        assert float(row["printed_rho1"]) == printed.rho1
        assert int(row["printed_label"]) == printed.label
    shown = {row["image"]: int(row["printed_accumulated_label"]) for row in rows_of(out / "table4.csv")}
    assert shown == TABLE_4


@pytest.mark.parametrize("space", ["image", "ground"])
def test_figures_6_and_7_stop_and_go_on(made, space):
    out, _ = made(space, "table4")
    _, text = made(space, "figure6")
    made(space, "figure7")
    used = [row["image"] for row in rows_of(out / "table4.csv") if row["used"] == "yes"]
    order = [row["image"] for row in rows_of(out / "table4.csv")]
    chosen, every = rows_of(out / "figure6.csv"), rows_of(out / "figure7.csv")
    assert list(curves_of(chosen, "ncc_")) == used
    assert list(curves_of(every, "ncc_")) == order
    assert 1 < len(used) < len(order)
    # Equation (2): the mean of all curves; equation (3) adds them one after the other.
    ncc, sncc = curves_of(every, "ncc_"), curves_of(every, "sncc_")
    for m in range(1, len(order) + 1):
        mean = np.mean([ncc[name] for name in order[:m]], axis=0)
        np.testing.assert_allclose(sncc[str(m)], mean, atol=2 * IN_CURVES)
    # Table 1 stops it there, and not before.
    labels = []
    for m in range(1, len(used) + 1):
        peaks = curve_peaks(sncc[str(m)][None], 0.5, OPTIONS)
        ratio = peak_ratio(peaks.rho1, peaks.rho2, OPTIONS)
        labels.append(int(quality_labels(peaks.rho1, ratio, peaks.is_open, OPTIONS)[0]))
    assert labels == [*[label for label in labels[:-1] if label < 1], 1]
    assert f"{len(used)} chosen: {', '.join(used)}" in text
    assert "0.7322" in text
    assert "4.5253" in text


def test_figure_7_compares_many_points(made):
    out, text = made("image", "figure7", "--points", 60)
    rows = rows_of(out / POINTS_FILE)
    chosen, every = (np.array([float(row[f"rho1_{name}"]) for row in rows]) for name in ("chosen", "all"))
    assert f"{len(rows)} stop before the last search image" in text
    assert f"{100 * (every < chosen).mean():.0f} %" in text
    assert f"{np.median(chosen):.3f}" in text
    assert all(1 <= int(row["n_chosen"]) < 5 for row in rows)


def test_figure_8_is_a_point_in_the_reference_image_and_lines_in_the_others(made):
    """The ray of a pixel is that pixel; the vertical line is a line in the reference image too."""
    for space in ("image", "ground"):
        out, _ = made(space, "figure8")
        rows = rows_of(out / "figure8.csv")
        for name in VIEWS:
            xy = np.array([
                (float(r["column"]), float(r["row"])) for r in rows
                if r["image"] == f"img_{name}" and r["point"] == "line"
            ])  # fmt: skip
            assert len(xy) == 2 * REACH + 1
            (start,) = (r for r in rows if r["image"] == f"img_{name}" and r["point"] == "start")
            heights = [float(r["height_m"]) for r in rows if r["image"] == f"img_{name}" and r["point"] == "line"]
            assert float(start["height_m"]) == pytest.approx(heights[REACH], abs=1e-3)
            np.testing.assert_allclose(xy[REACH], (float(start["column"]), float(start["row"])), atol=1e-2)
            length = np.hypot(*(xy[-1] - xy[0]))
            if name == "n1" and space == "image":
                assert length < 1e-3
            else:
                assert length > 1.0


def test_a_point_that_is_asked_for_is_shown_in_both_spaces(made):
    row, col = 60.0, 55.0
    for space in ("image", "ground"):
        _, text = made(space, "table4", "--pixel", row, col)
        found = [float(v) for v in text.split("img_n1 row ")[1].split("\n")[0].split(", column ")]
        # On the ground it is the middle of the cell.
        assert np.hypot(found[0] - row, found[1] - col) < (0.06 if space == "image" else 1.5)
        place = text.split("P0         ")[1].split(" m;")[0].replace("E ", "").replace("N ", "").split(", ")
        _, at = made(space, "table4", "--at", place[0], place[1])
        again = [float(v) for v in at.split("img_n1 row ")[1].split("\n")[0].split(", column ")]
        assert np.hypot(again[0] - found[0], again[1] - found[1]) < 1.5


def test_the_corners_of_a_triangle_order_the_images_too(made):
    _, text = made("image", "table4", "--neighbours", "tin")
    assert "3 feature points" in text


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["figure9"], "figure9 is not known; choose from table3, table4, figure3"),
        (["table3", "--space", "depth"], "--space depth is not known"),
        (["table3", "--at", "1", "2", "--pixel", "3", "4"], "Give one of both"),
        (["table3", "--neighbours", "tin", "--radius", "9"], "Leave --radius out"),
        (["table3", "--radius", "-1"], "--radius -1 is not a size"),
        (["table3", "--points", "9"], "table3 is asked for"),
        (["figure7", "--points", "-9"], "--points -9"),
        (["table3", "--at", "nan", "2"], "is no place"),
    ],
)
def test_a_bad_request_is_one_sentence_and_writes_nothing(tmp_path, arguments, says):
    result = zl(*arguments, "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert says in result.stderr
    assert result.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--pixel", "-50", "10"], "is not shown by the reference image img_n1"),
        (["--at", "0", "0"], "is not shown by the reference image img_n1"),
        (["--reference", "north"], "--reference north is not a view of this scene"),
        (["--pixel", "60", "55", "--radius", "1"], "Give a larger --radius"),
    ],
)
def test_a_point_that_cannot_be_shown_is_refused(town, tmp_path, more, says):
    result = zl("table3", *town, "-o", tmp_path / "out", *more)
    assert result.exit_code != 0
    assert says in result.stderr.splitlines()[-1]
    assert not (tmp_path / "out").exists()


def test_a_table_that_is_there_is_not_replaced(made, town):
    out, _ = made("image", "table3")
    before = (out / "table3.csv").read_bytes()
    result = zl("table3", *town, "-o", out)
    assert result.exit_code == 2
    assert "holds another table3" in result.stderr
    assert (out / "table3.csv").read_bytes() == before


def test_the_block_of_the_demo_is_rendered_once(tmp_path, monkeypatch):
    from zlocus.core.errors import OutputError
    from zlocus.core.progress import SilentProgress
    from zlocus.synthetic import files
    from zlocus.synthetic.linescan import TrajectoryNoise
    from zlocus.synthetic.scenes import demo_spec

    rendered = []

    def render_scene(spec, folder, progress, noise):
        folder.mkdir()
        rendered.append((spec, noise))
        return files.scene_files(spec, folder, is_linescan=True)

    monkeypatch.setattr(files, "render_scene", render_scene)
    monkeypatch.setattr(paper, "kernels_compiling", nullcontext)
    for _ in range(2):
        assert paper.demo_block(tmp_path, SilentProgress()) == (tmp_path / "scene" / "scene.yaml",)
    assert rendered == [(demo_spec(), TrajectoryNoise())]
    write_record(tmp_path / "block.json", {DIGEST: "of another version"})
    paper.demo_block(tmp_path, SilentProgress())
    assert len(rendered) == 2
    assert block_digest(demo_spec(), TrajectoryNoise()) in (tmp_path / "block.json").read_text(encoding="utf-8")
    (tmp_path / "block.json").unlink()
    with pytest.raises(OutputError, match="not the block of the demo"):
        paper.demo_block(tmp_path, SilentProgress())
