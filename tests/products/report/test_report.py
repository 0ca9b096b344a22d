"""report.html: every section and its figures, names that are code, parts that are missing, and what a browser says."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from typer.testing import CliRunner

import zlocus.pipeline.report_inputs
import zlocus.products.report.page as page
import zlocus.products.report.sampling as survey_module
from browser import found_browser
from places import ROOT
from rendered_scenes import HEIGHTS, SMALL_TILES, read, run, truth_at
from surveys import small
from zlocus.cli.app import app
from zlocus.core.errors import InputError, OutputError
from zlocus.core.options import RunConfig
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.table import accuracy_table
from zlocus.matching.pair_labels import LabelledTies
from zlocus.matching.quality import Quality
from zlocus.products.report import maps, tables
from zlocus.products.report import text as words
from zlocus.products.report.comparison import shrunk_means
from zlocus.products.report.example_cells import DOUBTFUL, FAILED, TYPICAL, chosen_cells
from zlocus.products.report.page import write_report
from zlocus.products.report.sampling import survey_rasters
from zlocus.products.tie_layers import write_ranking

SECTIONS = [
    "where", "heights", "ortho", "precision", "used", "reasons", "orientation", "pairs", "curves", "reference", "time",
    "options", "inputs",
]  # fmt: skip
VOID = {"meta", "img", "br", "link", "input", "hr"}
SCRIPTED = "<script>alert(1)</script>"
WIDTHS = (390, 1280)
# Of numbers with three digits behind the point.
ROUNDED = 6e-4
UNDULATION_M = 47.0
# Rows and columns of small rasters.
SHAPE = (6, 8)


class Page(HTMLParser):
    """Elements with their attributes, the text of each section, and whether all that opens closes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.texts: dict[str, str] = {}
        self._section = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        self._section = dict(attrs).get("id") or self._section if tag in ("section", "p") else self._section

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f"{tag} closes what did not open"

    def handle_data(self, data):
        self.texts[self._section] = self.texts.get(self._section, "") + " " + data

    def of(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]

    def text(self, section):
        return " ".join(self.texts[section].split())


def page_of(out: Path) -> Page:
    parsed = Page((out / "report.html").read_text(encoding="utf-8"))
    assert parsed.open == []
    return parsed


def zl(*arguments):
    return CliRunner().invoke(app, [*map(str, arguments)])


@pytest.fixture(scope="module")
def made(images, tmp_path_factory):
    """A run over all of the sine; not to be changed."""
    return run(images("sine"), tmp_path_factory.mktemp("report") / "out", SMALL_TILES, report=True).out


@pytest.fixture
def out(made, tmp_path):
    """A copy of it."""
    return Path(shutil.copytree(made, tmp_path / "out"))


def changed(out: Path, name: str, change) -> None:
    record = json.loads((out / name).read_text(encoding="utf-8"))
    change(record)
    (out / name).write_text(json.dumps(record), encoding="utf-8")


def test_the_page_has_every_section_with_its_heading_and_a_way_to_it(made):
    parsed = page_of(made)
    assert [each["id"] for each in parsed.of("section")] == SECTIONS
    assert [each["aria-labelledby"] for each in parsed.of("section")] == [each["id"] for each in parsed.of("h2")]
    links = {each["href"] for each in parsed.of("a")}
    assert {link for link in links if link.startswith("#")} == {f"#{name}" for name in SECTIONS}
    files = {link for link in links if not link.startswith("#")}
    assert (
        {"dsm.tif", "quality.tif", "hillshade.tif", "run.json"}
        <= files
        == {each for each in files if (made / each).exists()}
    )
    assert len(parsed.of("h1")) == 1
    assert all(each["alt"] for each in parsed.of("img"))
    assert all("scope" in each for each in parsed.of("th"))


def test_nothing_is_asked_of_anyone(made):
    text = (made / "report.html").read_text(encoding="utf-8")
    parsed = page_of(made)
    assert not re.search(r"https?://|//[a-z]+\.|@import|url\(", text)
    assert all(each["src"].startswith("data:image/") for each in parsed.of("img"))
    assert not {name for name, _ in parsed.elements} & {"link", "iframe", "object", "embed", "base", "form"}
    for each in parsed.of("img"):
        kind, content = each["src"].split(";base64,")
        if kind == "data:image/svg+xml":
            svg = base64.b64decode(content).decode()
            assert re.findall(r'(?:href|src)="([^"#])', svg) == []
            assert "<script" not in svg


def test_its_figures_are_those_of_the_record(made):
    parsed, record = page_of(made), json.loads((made / "run.json").read_text())
    assert f"{100 * record['coverage']:.1f} % have a height" in parsed.text("summary")
    assert "made from 3 images" in parsed.text("summary")
    assert f"Made on {record['created'][:10]} {record['created'][11:16]} UTC" in parsed.text("")
    residuals = parsed.text("orientation")
    assert f"{record['orientation']['n_ties']} tie points" in residuals
    for name, view in record["orientation"]["views"].items():
        figures = [view["n_ties"], *(view[key] for key in ("residual_before_px", "residual_after_px"))]
        row = residuals[residuals.index(f" {name} ") :]
        assert row.split()[2] == str(figures[0])
        assert [float(v) for v in re.findall(r" (\d\.\d{3})", row)[:6]] == pytest.approx(
            [each[key] for each in figures[1:] for key in ("median", "rms", "percent90")], abs=ROUNDED
        )
    for stage in record["stages"]:
        assert words.seconds(stage["wall_s"]) in parsed.text("time")
    assert f"{max(stage['peak_mb'] for stage in record['stages']):.0f} MB" in parsed.text("time")
    options = parsed.text("options")
    assert "pyramid.tile 80 1024" in options  # the value and the default that it is not
    assert "heights 25.0 80.0" in options
    assert all(each["sha256"] in parsed.text("inputs") for each in record["inputs"])


def test_counts_are_those_of_the_rasters(made):
    found, (quality, _), (height, _) = survey_rasters(made), read(made / "quality.tif"), read(made / "dsm.tif")
    record = json.loads((made / "run.json").read_text())
    assert found.n_heights / found.n_covered == pytest.approx(record["coverage"], abs=1e-6)
    assert found.n_heights == np.isfinite(height).sum()
    for row in words.reasons(found):
        flag = Quality[row.name]
        counted = np.isfinite(height) if row.fate in ("kept", "filled") else np.ones(height.shape, bool)
        assert row.n == (((quality & flag) != 0) & counted).sum() > 0
        assert row.value == flag
    text = page_of(made).text("reasons")
    for flag in Quality:
        assert (flag.name in text[text.index("Reasons that do not occur") :]) == (found.count(flag) == 0)
    np.testing.assert_array_equal(found.height, height)


def test_the_footprints_hold_the_surface(made):
    svg = next(each for name, each in page_of(made).elements if name == "svg")
    assert "3 images" in svg["aria-label"]
    outlines = [np.array([p.split(",") for p in each["points"].split()], float) for each in page_of(made).of("polygon")]
    assert len(outlines) == 4
    assert [each["fill"] for each in page_of(made).of("text")] == [
        each["stroke"] for each in page_of(made).of("polygon")
    ][:3]
    assert all((each >= -0.05).all() and (each <= page.DRAWING_SIDE + 0.05).all() for each in outlines)
    # What two images share is about what the surface covers.
    middle = [each.mean(axis=0) for each in outlines]
    assert np.ptp(middle, axis=0).max() < 0.2 * page.DRAWING_SIDE


def test_labels_are_a_sample_where_no_images_were_ranked(made):
    """Good images, compared as `zlocus rank` compares them, at most of the places at which it does."""
    labels = json.loads((made / "curves.json").read_text())["labels"]
    n_ties = json.loads((made / "run.json").read_text())["orientation"]["n_ties"]
    assert labels["points"] <= n_ties  # none counts twice, though places lie close here
    assert not (made / "ranking.gpkg").exists()
    pairs = {frozenset(pair["images"]) for pair in labels["pairs"]}
    assert pairs == {frozenset(two) for two in (("fore", "nadir"), ("aft", "nadir"), ("aft", "fore"))}
    for pair in labels["pairs"]:
        assert pair["good"] + pair["fair"] + pair["poor"] == pair["points"] == labels["points"] > 20
        assert pair["poor"] < 0.1 * pair["points"] < pair["good"]
    text = page_of(made).text("pairs")
    assert f"The labels come from a sample that was made for this page: {labels['points']} tie points" in text
    titles = [each["title"] for each in page_of(made).of("td") if "against" in (each.get("title") or "")]
    assert len(titles) == 6
    good = {frozenset(pair["images"]): words.percent(pair["good"], pair["points"]) for pair in labels["pairs"]}
    assert f"fore against nadir: good at {good[frozenset(('fore', 'nadir'))]}" in " ".join(titles)


def test_labels_that_cannot_be_sampled_fail_no_run(images, tmp_path, monkeypatch):
    def broken(*_):
        raise RuntimeError("no luck")

    monkeypatch.setattr(zlocus.pipeline.report_inputs, "rank_tile", broken)
    out = run(images("sine"), tmp_path / "out", SMALL_TILES, report=True).out
    assert "There are no labels of pairs. The sample could not be made: RuntimeError: no luck." in page_of(out).text(
        "pairs"
    )
    assert page_of(out).text("curves").count("Typical: ") == 3


def test_samples_keep_to_their_time(images, tmp_path, monkeypatch):
    """The first place is always looked at, the others while there is time."""
    asked = []
    monkeypatch.setattr(zlocus.pipeline.report_inputs, "TIME_SHARE", 0.0)
    monkeypatch.setattr(zlocus.pipeline.report_inputs, "LEAST_TIME_S", 0.0)
    rank_tile = zlocus.pipeline.report_inputs.rank_tile
    monkeypatch.setattr(
        zlocus.pipeline.report_inputs, "rank_tile", lambda *these: asked.append(these) or rank_tile(*these)
    )
    run(images("sine"), tmp_path / "out", SMALL_TILES, report=True)
    assert len(asked) == 1


def test_pairs_and_why_there_are_no_labels(out):
    made = out
    (made / "curves.json").unlink()
    write_report(made)
    text = page_of(made).text("pairs")
    assert "The run wrote no ranking of these images (ranking.gpkg), and no sample of one (curves.json)." in text
    record = json.loads((made / "footprints.geojson").read_text())
    pairs = [each["properties"] for each in record["features"] if each["properties"]["kind"] == "overlap"]
    assert len(pairs) == 3
    for pair in pairs:
        assert words.number(pair["base_to_height"]) in text
    # Looks of 18 and -17 degrees along, 2 and 4 across.
    assert next(p for p in pairs if p["views"] == ["aft", "fore"])["base_to_height"] == pytest.approx(0.63, abs=0.02)


def test_curves_of_typical_cells_peak_at_their_heights(made):
    record = json.loads((made / "curves.json").read_text())
    typical = [cell for cell in record["cells"] if cell["kind"] == TYPICAL]
    assert len(typical) == 3
    height, source = read(made / "dsm.tif")
    truth = truth_at("sine", source)
    for cell in typical:
        assert cell["height_m"] == height[cell["row"], cell["col"]]
        assert abs(cell["point"]["peak_m"] - truth[cell["row"], cell["col"]]) < 2 * cell["point"]["step_m"]
        assert cell["svg"].startswith("<svg")
    cards = page_of(made).text("curves")
    assert cards.count("Typical: ") == 3
    assert f"{typical[0]['height_m']:.2f} m" in cards


def test_heights_of_the_curves_have_the_vertical_datum_of_the_surface(images, tmp_path):
    scene = images("sine")
    geoid = tmp_path / "geoid.tif"
    profile = {"driver": "GTiff", "count": 1, "dtype": "float32", "crs": "EPSG:4326", "width": 4, "height": 4}
    with rasterio.open(geoid, "w", **profile, transform=Affine(90.0, 0, -180.0, 0, -45.0, 90.0)) as file:
        file.write(np.full((4, 4), UNDULATION_M, np.float32), 1)
    out = run(
        scene,
        tmp_path / "out",
        SMALL_TILES,
        report=True,
        vertical=str(geoid),
        heights=tuple(z - UNDULATION_M for z in HEIGHTS),
    ).out
    typical = [cell for cell in json.loads((out / "curves.json").read_text())["cells"] if cell["kind"] == TYPICAL]
    height, _ = read(out / "dsm.tif")
    for cell in typical:
        step_m = cell["point"]["step_m"]
        assert abs(cell["point"]["peak_m"] - height[cell["row"], cell["col"]]) < 3 * step_m < UNDULATION_M / 10
        assert cell["undulation_m"] == pytest.approx(UNDULATION_M)
    text = page_of(out).text("curves")
    assert "above the geoid of geoid.tif" in text
    assert "ellipsoid" not in text


def test_terrain_and_contours_are_shown_where_they_are_made(made, out):
    assert "terrain" not in {each["id"] for each in page_of(made).of("section")}
    assert zl("products", out, "--products", "dtm,contours", "--set", "products.contours_of=dtm").exit_code == 0
    changed(out, "run.json", lambda record: record["config"]["options"]["products"].update(contours_of="dtm"))
    write_report(out)
    parsed = page_of(out)
    assert "Contours of the terrain" in parsed.text("terrain")
    links = {each["href"] for each in parsed.of("a")}
    assert {"#terrain", "dtm.tif", "contours.gpkg"} <= links
    assert sum("Contours" in each["alt"] for each in parsed.of("img")) == 1


def test_names_that_are_code_do_not_run(out):
    def rename(record):
        views = record["orientation"]["views"]
        record["orientation"]["views"] = {SCRIPTED if name == "fore" else name: views[name] for name in views}
        for pair in record["orientation"]["pairs"]:
            pair["views"] = [SCRIPTED if name == "fore" else name for name in pair["views"]]
        record["config"]["request"]["out"] = '"><img src=x onerror=alert(1)>'

    def rename_feature(record):
        for each in record["features"]:
            if each["properties"].get("name") == "fore":
                each["properties"]["name"] = SCRIPTED

    changed(out, "run.json", rename)
    changed(out, "footprints.geojson", rename_feature)
    changed(out, "curves.json", lambda record: record["cells"][0].update(error=SCRIPTED))
    write_report(out)
    parsed = page_of(out)
    assert len(parsed.of("script")) == 1
    assert SCRIPTED in parsed.text("orientation")
    assert f"No curve could be made: {SCRIPTED}" in parsed.text("curves")
    assert not any("onerror" in each for _, each in parsed.elements)
    assert all(each["src"].startswith("data:") for each in parsed.of("img"))


def test_missing_parts_are_said_in_words(out):
    (out / "curves.json").unlink()
    (out / "footprints.geojson").unlink()
    write_report(out)
    parsed = page_of(out)
    assert "no match curves" in parsed.text("curves")
    assert "wrote no footprints" in parsed.text("where")
    assert "no reference was given" in parsed.text("reference")


def test_a_surface_without_any_height_has_a_page(out):
    for name, value in (("dsm", np.nan), ("sigma", np.nan), ("views", 0), ("quality", int(Quality.NO_MATCH))):
        with rasterio.open(out / f"{name}.tif", "r+", IGNORE_COG_LAYOUT_BREAK="YES") as file:
            file.write(np.full(file.shape, value, file.dtypes[0]), 1)
    changed(out, "run.json", lambda record: record.update(coverage=0.0))
    write_report(out)
    parsed = page_of(out)
    assert "cover, 0.00 % have a height" in parsed.text("summary")
    assert "100.0 % of the requested cells have no height, mostly because: the images do not agree" in parsed.text(
        "summary"
    )
    assert "No height has a standard deviation" in parsed.text("precision")


def test_the_comparison_is_that_of_evaluate(out, tmp_path):
    _, source = read(out / "dsm.tif")
    truth = truth_at("sine", source).astype(np.float32)
    truth[:40] += 3.0  # errors that count
    profile = {"driver": "GTiff", "count": 1, "dtype": "float32", "nodata": float("nan")}
    reference = tmp_path / "<b>truth.tif"
    with rasterio.open(
        reference, "w", crs=source.crs, transform=source.transform, width=source.width, height=source.height, **profile
    ) as file:
        file.write(truth, 1)
    result = zl("report", out, "--reference", reference, "--margin", 5, "--threshold", 0.5)
    assert result.exit_code == 0, result.output
    evaluation = evaluate(out / "dsm.tif", Comparison(reference, margin_m=5, threshold_m=0.5))
    figures, aligned = evaluation.absolute_accuracy.statistics, evaluation.aligned_accuracy.statistics
    text = page_of(out).text("reference")
    table = accuracy_table(evaluation)
    assert table.kind_headings == ("within", "median", "NMAD", "RMSE", "LE90", "LE95")
    assert " ".join(("cells complete absolute aligned", *table.kind_headings * 2)) in text
    assert [row[0][0] for row in table.rows] == ["all", "0-5 deg", "5-15 deg", "15-30 deg", "30-45 deg", "45-90 deg"]
    for row in table.rows:
        assert " ".join(" ".join(cell for part in row for cell in part).split()) in text
    assert "Within: share of all cells in error by less than 0.5 m; errors in m." in text
    assert "MVS3DM, absolute: completeness" in text
    assert "<b>truth.tif" in text
    summary = page_of(out).text("summary")
    assert f"As the surface lies (absolute), {100 * figures.within:.1f} % have one with an error below 0.5 m" in summary
    assert f"is removed (aligned), {100 * aligned.within:.1f} % have one with an error below 0.5 m" in summary
    assert "Map of the absolute errors" in text
    alts = [each["alt"] for each in page_of(out).of("img")]
    assert len([alt for alt in alts if alt.startswith("Error of height")]) == 1
    (histogram,) = (alt for alt in alts if alt.startswith("Histogram of the errors"))
    assert f"NMAD {figures.nmad:.3f} m" in histogram


def test_a_reference_above_a_geoid_is_compared_above_the_ellipsoid(out, tmp_path):
    _, source = read(out / "dsm.tif")
    truth, reference, geoid = (
        truth_at("sine", source).astype(np.float32),
        tmp_path / "truth.tif",
        tmp_path / "geoid.tif",
    )
    profile = {
        "driver": "GTiff", "count": 1, "dtype": "float32", "nodata": float("nan"), "crs": source.crs,
        "transform": source.transform, "width": source.width, "height": source.height,
    }  # fmt: skip
    for path, heights in ((reference, truth - UNDULATION_M), (geoid, np.full_like(truth, UNDULATION_M))):
        with rasterio.open(path, "w", **profile) as file:
            file.write(heights, 1)
    result = zl(
        "report", out, "--reference", reference, "--geoid", geoid, "--coregister", "nuth-kaab", "--slopes", "20"
    )
    assert result.exit_code == 0, result.output
    text = page_of(out).text("reference")
    assert f"The geoid's heights were added to those of {reference}." in text
    assert "Map of the aligned errors" in text
    assert "20-90 deg" in text
    alts = [each["alt"] for each in page_of(out).of("img")]
    (histogram,) = (alt for alt in alts if alt.startswith("Histogram of the errors"))
    median_m = float(histogram.split("about their median ")[1].split()[0])
    assert abs(median_m) < UNDULATION_M / 10
    assert "Aligned: removed first:" in text


def test_means_of_blocks_leave_out_what_is_not_known():
    values = np.array([[1.0, 3.0, np.nan], [np.nan, 5.0, np.nan], [7.0, np.nan, 2.0]], np.float32)
    np.testing.assert_array_equal(shrunk_means(values, 2), np.array([[3.0, np.nan], [7.0, 2.0]], np.float32))
    np.testing.assert_array_equal(shrunk_means(values, 3), values)


def test_a_curve_that_fails_fails_no_run(images, tmp_path, monkeypatch):
    def broken(*_):
        raise RuntimeError("no luck\nat all")

    monkeypatch.setattr(zlocus.pipeline.report_inputs, "curves_at", broken)
    out = run(images("sine"), tmp_path / "out", SMALL_TILES, report=True).out
    assert "No curve could be made: RuntimeError: no luck at all." in page_of(out).text("curves")


def test_a_report_that_fails_fails_no_run(images, tmp_path, monkeypatch, capsys):
    def broken(*_):
        raise RuntimeError("no luck")

    monkeypatch.setattr(zlocus.pipeline.report_inputs, "write_report", broken)
    inputs = images("sine").inputs
    result = zl("dsm", *inputs, "--crs", "EPSG:32632", "--heights", *HEIGHTS, "-o", tmp_path / "out")
    assert result.exit_code == 0
    assert "report.html was not made: RuntimeError: no luck." in result.stderr
    assert not (tmp_path / "out" / "report.html").exists()
    assert (tmp_path / "out" / "dsm.tif").exists()


def test_no_report_leaves_none_not_even_an_old_one(images, out):
    result = zl(
        "dsm", *images("sine").inputs, "--crs", "EPSG:32632", "--heights", *HEIGHTS, "--no-report", "--overwrite", "-o",
        out,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert not {"report.html", "curves.json", "footprints.geojson"} & {path.name for path in out.iterdir()}
    assert "curves" not in [stage["name"] for stage in json.loads((out / "run.json").read_text())["stages"]]
    assert zl("report", out).exit_code == 0
    assert "no match curves" in page_of(out).text("curves")


def test_a_surface_is_the_same_with_and_without_a_report(images, made, tmp_path):
    other = run(images("sine"), tmp_path / "out", SMALL_TILES, report=False).out
    for name in ("dsm", "sigma", "quality", "views"):
        assert (other / f"{name}.tif").read_bytes() == (made / f"{name}.tif").read_bytes()


@pytest.mark.parametrize(
    ("prepare", "arguments", "says"),
    [
        (lambda out: (out / "run.json").unlink(), (), "There is no run.json in"),
        (lambda out: (out / "run.json").write_text("{"), (), "(char 1). Make the surface again."),
        (lambda out: (out / "run.json").write_text("[]"), (), "holds no JSON object"),
        (lambda out: (out / "run.json").write_text('{"schema": 2}'), (), "lacks config, versions"),
        (lambda out: (out / "sigma.tif").unlink(), (), "There is no raster"),
        (lambda out: None, ("--classes", "c.tif"), "--classes is about a reference"),
        (lambda out: None, ("--align",), "--align is about a reference"),
        (lambda out: None, ("--geoid", "g.tif"), "--geoid is about a reference"),
        (lambda out: None, ("--reference", "moon.tif"), "moon.tif"),
    ],
)
def test_what_cannot_be_shown_is_one_sentence(out, prepare, arguments, says):
    (out / "report.html").write_text("old", encoding="utf-8")
    prepare(out)
    result = zl("report", out, *arguments)
    assert result.exit_code == 2
    assert says in result.stderr.splitlines()[-1]
    assert (out / "report.html").read_text(encoding="utf-8") == "old"


def test_rasters_of_different_grids_are_refused(out):
    with rasterio.open(out / "sigma.tif", "r+", IGNORE_COG_LAYOUT_BREAK="YES") as file:
        file.transform = Affine(1.0, 0.0, 7.0, 0.0, -1.0, 0.0)
    with pytest.raises(InputError, match=r"sigma\.tif is not on the grid of dsm\.tif"):
        survey_rasters(out)


def test_a_page_that_cannot_be_written_is_a_sentence(out, monkeypatch):
    def full(self, target):
        raise OSError(28, "No space left on device")

    before = (out / "report.html").read_bytes()
    monkeypatch.setattr("os.replace", lambda *_: full(None, None))
    with pytest.raises(OutputError, match=r"report\.html cannot be written: No space left"):
        write_report(out)
    assert (out / "report.html").read_bytes() == before
    assert not list(out.glob(".report*"))


def test_typical_cells_lie_at_the_quartiles():
    quality = np.zeros(SHAPE, np.uint16)
    sigma = np.arange(48, dtype=np.float32).reshape(SHAPE)
    quality[sigma > 40] = Quality.WEAK
    cells = [cell for cell in chosen_cells(small(quality, sigma=sigma)) if cell.kind == TYPICAL]
    assert [cell.row * SHAPE[1] + cell.col for cell in cells] == [10, 20, 30]


def test_failed_cells_lie_in_the_middle_of_the_largest_patch():
    quality = np.zeros((20, 20), np.uint16)
    quality[2:9, 2:9] = Quality.NO_MATCH
    quality[12:15, 12:15] = Quality.NO_MATCH
    quality[18, 18] = Quality.OCCLUDED
    quality[10, 0] = Quality.OUTSIDE
    quality[0, 19] = Quality.RANGE_END
    quality[0, 18] = Quality.RANGE_END | Quality.FILLED  # which has a height
    height = np.where((quality == 0) | (quality & Quality.FILLED != 0), 5.0, np.nan).astype(np.float32)
    cells = [cell for cell in chosen_cells(small(quality, height)) if cell.kind == FAILED]
    assert [(cell.why, cell.row, cell.col) for cell in cells] == [
        ("NO_MATCH", 5, 5), ("RANGE_END", 0, 19), ("OCCLUDED", 18, 18),
    ]  # fmt: skip
    assert cells[0].others == ((13, 13),)


def test_doubtful_cells_are_of_the_most_common_warnings():
    quality = np.zeros((20, 20), np.uint16)
    quality[:6] = Quality.DISPUTED
    quality[8:11] = Quality.WEAK
    quality[15, 3] = Quality.AMBIGUOUS
    cells = [cell for cell in chosen_cells(small(quality)) if cell.kind == DOUBTFUL]
    assert [cell.why for cell in cells] == ["DISPUTED", "WEAK"]
    assert (cells[0].row, cells[1].row) in {(2, 9), (3, 9)}


def test_cells_at_regular_distances_over_all_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr(survey_module, "MAX_SAMPLED_SIDE", 100)
    rng = np.random.default_rng(3)
    rows, cols = 1037, 613
    profile = {"driver": "GTiff", "width": cols, "height": rows, "count": 1, "crs": "EPSG:32632",
               "transform": Affine(0.5, 0.0, 5e5, 0.0, -0.5, 5e6), "tiled": True, "blockxsize": 256,
               "blockysize": 256}  # fmt: skip
    values = {
        "dsm": rng.normal(size=(rows, cols)).astype(np.float32), "sigma": rng.random((rows, cols)).astype(np.float32),
        "quality": rng.choice([0, 1, 2, 16, 17, 256, 272], size=(rows, cols)).astype(np.uint16),
        "views": rng.integers(0, 9, (rows, cols)).astype(np.uint8),
    }  # fmt: skip
    for name, array in values.items():
        with rasterio.open(tmp_path / f"{name}.tif", "w", dtype=array.dtype.name, **profile) as file:
            file.write(array, 1)
    found = survey_rasters(tmp_path)
    assert found.stride == 11
    for name, kept in (("dsm", found.height), ("sigma", found.sigma), ("quality", found.quality),
                       ("views", found.views)):  # fmt: skip
        np.testing.assert_array_equal(kept, values[name][found.first :: 11, found.first :: 11])
    counts = Counter(values["quality"].ravel().tolist())
    assert found.n_requested == rows * cols - counts[1] - counts[17]
    assert found.n_covered == found.n_requested - counts[2]
    assert found.count(Quality.OUTSIDE) == counts[1] + counts[17]
    assert found.count(Quality.NO_MATCH) == counts[16] + counts[272]
    # Of a height that is not there nothing can be warned.
    assert found.count(Quality.WEAK) == counts[256]
    np.testing.assert_array_equal(found.n_used[:9], np.bincount(values["views"].ravel()))


@pytest.mark.parametrize("most_columns", [100, 2])
def test_labels_of_pairs(tmp_path, monkeypatch, most_columns):
    """Whether images have a column each, or are too many for that."""
    from pyproj import CRS

    monkeypatch.setattr("zlocus.products.tie_layers.MAX_COLUMNS", most_columns)
    names = ["nadir", "fore", "aft"]
    labels = np.zeros((4, 3, 3), np.int8)
    labels[:, 0, 1] = [1, 1, 1, -1]
    labels[:, 1, 0] = -1
    labels[:, 0, 2] = 1
    ranked = LabelledTies(np.arange(12.0).reshape(4, 3), labels, np.arange(3))
    write_ranking(tmp_path / "ranking.gpkg", [ranked], names, CRS.from_epsg(32632))
    found = tables.label_matrix(tmp_path / "ranking.gpkg", ["aft", "fore", "nadir"])
    text = {(found.names[i], found.names[j]): found.cell_rows[i][j].text for i in range(3) for j in range(3)}
    assert (text["nadir", "fore"], text["fore", "nadir"], text["nadir", "aft"]) == ("75", "0", "100")
    assert (text["aft", "aft"], text["aft", "fore"]) == ("", "0")
    titles = [cell.title for row in found.cell_rows for cell in row]
    assert "fore against nadir: good at 75.0 %, fair at 0.00 %, poor at 25.0 % of 4 tie points" in titles
    assert tables.label_matrix(tmp_path / "ranking.gpkg", ["aft", "fore"]) is None
    assert tables.label_matrix(tmp_path / "none.gpkg", names) is None


def test_reasons_are_said_as_the_documents_say_them():
    page_text = (ROOT / "docs" / "reference" / "quality.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page_text.splitlines()]
    said = {row[1]: (row[2], row[3]) for row in rows if row[0].isdigit()}
    assert said == {flag.name: (words.MEANINGS[flag], words.fate(flag)) for flag in Quality}


def test_every_reason_has_a_colour_of_its_group():
    group = maps.groups_of(np.array([0, *(int(flag) for flag in Quality)]))
    assert group[0] == len(maps.FLAG_GROUPS)
    for flag, k in zip(Quality, group[1:], strict=True):
        assert flag.name in maps.FLAG_GROUPS[k][0] or flag in (Quality.OUTSIDE, Quality.UNSEEN)
    both = maps.groups_of(np.array([int(Quality.NO_MATCH | Quality.FILLED), int(Quality.FILLED)]))
    assert both[0] == both[1]  # filled, whatever was the matter
    water = maps.groups_of(np.array([int(Quality.WATER), int(Quality.WATER | Quality.UNSEEN)]))
    assert "WATER" in maps.FLAG_GROUPS[water[0]][0]
    colours = [colour for _, _, colour in maps.FLAG_GROUPS] + [maps.NO_FLAG[1]]
    assert len(set(colours)) == len(colours)


def test_gaps_below_masks_are_no_lack_of_images(made):
    """In the summary and in the map of reasons."""
    found = survey_rasters(made)
    codes = np.zeros_like(found.codes)
    for code, n in ((0, 70), (Quality.MASKED, 20), (Quality.UNSEEN, 10), (Quality.MASKED | Quality.OUTSIDE, 30)):
        codes[int(code)] = n
    counted = replace(found, codes=codes, n_heights=70)
    assert counted.n_masked == 20
    assert words.what_is_missing(counted) == (
        "30.0 % of the requested cells have no height, mostly because: masks leave fewer than two images (20.0 %); "
        f"{words.MEANINGS[Quality.UNSEEN]} (10.0 %). A cell may have both reasons."
    )
    masked, unseen, water = maps.groups_of(
        np.array([int(Quality.MASKED), int(Quality.UNSEEN), int(Quality.MASKED | Quality.WATER)])
    )
    assert "masks leave" in maps.FLAG_GROUPS[masked][0]
    assert "covered by fewer than two images" in maps.FLAG_GROUPS[unseen][0]
    assert "WATER" in maps.FLAG_GROUPS[water][0]


def test_levelled_water_is_counted_as_water_alone(made):
    """Neither as filled nor as a plane, and not among the cells that should be matched."""
    found = survey_rasters(made)
    codes = np.zeros_like(found.codes)
    for code, n in ((0, 50), (Quality.WATER, 20), (Quality.WATER | Quality.UNSEEN, 3), (Quality.FILLED, 5),
                    (Quality.PLANE, 7), (Quality.UNSEEN, 11), (Quality.OUTSIDE, 13)):  # fmt: skip
        codes[int(code)] = n
    counted = replace(found, codes=codes, n_heights=85)
    assert [counted.count(flag) for flag in (Quality.WATER, Quality.FILLED, Quality.PLANE)] == [23, 5, 7]
    assert (counted.n_covered, counted.n_matched) == (62, 57)
    (row,) = (row for row in words.reasons(counted) if row.name == "WATER")
    assert (row.n, row.fate, row.meaning) == (23, "levelled", words.MEANINGS[Quality.WATER])


def test_the_summary_tells_parts_that_were_redone():
    entries = [{"cells_changed": n, "time": f"2026-01-0{n}T10:00:00+00:00"} for n in range(1, 5)]
    assert words.what_was_redone({}) == ""
    assert words.what_was_redone({"redone": entries[:1]}) == (
        "1 part was redone after the run (1 cells on 2026-01-01): times and options on this page are those of the "
        "run; see run.json."
    )
    assert words.what_was_redone({"redone": entries}).startswith(
        "4 parts were redone after the run (2 cells on 2026-01-02, 3 cells on 2026-01-03, 4 cells on 2026-01-04): "
    )


def test_the_summary_tells_levels_and_possible_water():
    levels = [{"name": f"polygon {k}", "level_m": 400.0 + k, "kind": "levelled"} for k in range(1, 8)]
    said = words.what_is_water({"water": {"levelled": levels, "possible": 2}})
    assert said.startswith("7 water surfaces have one level each, not matched heights: polygon 1 at 401.00 m, ")
    assert said.endswith(" and 2 more. Water is possible in 2 areas (3 in water.tif), where the images agree at no "
                         "height.")  # fmt: skip
    possible = [{"name": "possible water 1", "level_m": 1.0, "kind": "possible_levelled"}]
    assert words.what_is_water({"water": {"levelled": possible, "possible": 1}}) == (
        "1 water surface has one level, not matched heights: possible water 1 at 1.00 m."
    )
    assert words.what_is_water({"water": {"possible": 0, "doubts": ["The level is odd."]}}) == "The level is odd."
    assert words.what_is_water({}) == ""


@pytest.mark.parametrize(
    ("value", "text"), [(0.0831, "0.083 m"), (0.31, "0.31 m"), (12.4, "12 m"), (0.0, "0 m"), (float("nan"), "–")]
)
def test_sizes_have_two_digits_that_count(value, text):
    assert words.size(value, "m") == text


@pytest.mark.parametrize(
    ("n", "total", "text"),
    [
        (0, 5, "0.00 %"), (1, 1e6, "< 0.01 %"), (1, 30, "3.33 %"), (1, 3, "33.3 %"), (1, 0, "–"),
        # Only all is all.
        (9995, 10000, "99.95 %"), (9989, 10000, "99.9 %"), (10**6 - 1, 10**6, "> 99.99 %"), (5, 5, "100.0 %"),
    ],
)  # fmt: skip
def test_shares(n, total, text):
    assert words.percent(n, total) == text


def test_changed_options_are_marked():
    from zlocus.io.config import config_as_dict

    config = replace(RunConfig(), checks=replace(RunConfig().checks, max_sigma_m=0.5))
    rows = {row.name: row for row in tables.option_rows(config_as_dict(config))}
    assert (rows["checks.max_sigma_m"].value, rows["checks.max_sigma_m"].default) == ("0.5", "not given")
    assert [name for name, row in rows.items() if row.default] == ["checks.max_sigma_m"]
    assert all(row.meaning for row in rows.values())


LOOK = """<!DOCTYPE html><title>waiting</title><script>
addEventListener("load", () => {{
  const found = [...document.querySelectorAll("iframe")].map(frame => {{
    const page = frame.contentDocument, images = [...page.images];
    return {{
      width: frame.clientWidth, wide: page.documentElement.scrollWidth, images: images.length,
      shown: images.filter(each => each.complete && each.naturalWidth > 0).length,
      asked: frame.contentWindow.performance.getEntriesByType("resource").map(each => each.name)
        .filter(name => !name.startsWith("data:")),
      scripts: page.scripts.length,
      hints: [...page.querySelectorAll(".hint")].filter(each => each.offsetHeight > 0).length,
      cut: [...page.querySelectorAll(".wide")].filter(each => each.scrollWidth > each.clientWidth
        && !(each.previousElementSibling.matches(".hint") && each.previousElementSibling.offsetHeight > 0)).length,
    }};
  }});
  document.title = JSON.stringify(found);
}});
</script>{frames}"""


def test_a_browser_shows_it_at_both_widths_and_asks_for_nothing(out):
    browser = found_browser()
    frames = "".join(f'<iframe src="report.html" style="border:0;width:{w}px;height:900px"></iframe>' for w in WIDTHS)
    (out / "look.html").write_text(LOOK.format(frames=frames), encoding="utf-8")
    command = [
        browser, "--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files",
        f"--user-data-dir={out / 'browser'}", "--enable-logging=stderr", "--window-size=1800,1000",
        "--virtual-time-budget=20000", "--dump-dom", (out / "look.html").as_uri(),
    ]  # fmt: skip
    said = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    (title,) = re.findall(r"<title>(.*?)</title>", said.stdout)
    seen = json.loads(title)
    assert [each["width"] for each in seen] == list(WIDTHS)
    for each in seen:
        assert each["wide"] <= each["width"]  # nothing beyond the edge
        assert each["shown"] == each["images"] > 5
        assert each["asked"] == []
        assert each["scripts"] == 1
        assert each["cut"] == 0  # tables that scroll say so
    assert seen[0]["hints"] >= 3
    assert seen[1]["hints"] == 0
    assert "CONSOLE" not in said.stderr
