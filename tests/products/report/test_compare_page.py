"""compare.html: what it says of two runs and of rasters, and that it needs no other file."""

from __future__ import annotations

import re

import numpy as np
import pytest
import rasterio

from browser import found_browser
from rendered_scenes import PART, SMALL_TILES, run
from zlocus.core.errors import InputError, OutputError
from zlocus.core.options import CheckOptions, PyramidOptions, RunConfig
from zlocus.products.report.compare_page import (
    compared_runs,
    comparison_text,
    page_context,
    saturated_difference_m,
    write_comparison,
)

SECTIONS = ["brief", "differences", "where", "heights", "options", "time", "cameras", "inputs"]
WIDTHS = (390, 1280)


@pytest.fixture(scope="module")
def runs(images, tmp_path_factory):
    """Two runs of the sine: the second of another area, with other options."""
    folder = tmp_path_factory.mktemp("<b>runs")
    bounds = (PART[0] + 5, PART[1], PART[2] + 6, PART[3])
    config = RunConfig(pyramid=PyramidOptions(tile=80), checks=CheckOptions(max_sigma_m=3.0))
    first = run(images("sine"), folder / "first", SMALL_TILES, bounds=PART).out
    return first, run(images("sine"), folder / "second", config, bounds=bounds, resolution=0.6).out


@pytest.fixture(scope="module")
def comparison(runs):
    return compared_runs(*runs)


def test_the_page_has_every_section_and_loads_nothing(comparison, tmp_path):
    page = write_comparison(tmp_path / "out", comparison)
    text = page.read_text(encoding="utf-8")
    assert re.findall(r'<section id="(\w+)"', text) == SECTIONS
    assert all(f'href="#{name}"' in text for name in SECTIONS)
    assert not re.search(r'(?:src|href)="(?!data:|#)', text)
    assert "default-src 'none'" in text
    assert "<b>runs" not in text  # a name of a folder is text, not code
    assert "&lt;b&gt;runs" in text
    assert "checks.max_sigma_m" in text
    assert "All versions are the same." in text
    assert "Both runs read the same 3 files" in text
    assert not list(tmp_path.glob("out/.*"))


def test_the_raster_of_the_differences_is_that_of_the_grid(comparison, runs, tmp_path):
    write_comparison(tmp_path, comparison)
    with rasterio.open(tmp_path / "difference.tif") as file, rasterio.open(runs[0] / "dsm.tif") as first:
        assert (file.shape, file.transform, file.units) == (first.shape, first.transform, ("m",))
        np.testing.assert_array_equal(file.read(1), comparison.differences.difference)


def test_what_it_says_of_two_runs(comparison, runs):
    context = page_context(comparison)
    brief = {row.name: (row.first, row.second) for row in context["brief"]}
    assert brief["cell"] == ("0.5 m", "0.6 m")
    assert brief["vertical datum"] == ("the ellipsoid", "the ellipsoid")
    assert brief["CRS"][0] == "WGS 84 / UTM zone 32N, EPSG:32632"
    assert "tie points" in brief
    assert [row.name for row in context["options"]] == ["resolution", "bounds", "checks.max_sigma_m"]
    assert context["where"] is not None
    counts = dict(row.meaning.split(": ") for row in context["where"][1])
    assert counts["only in A"] == f"{int(comparison.differences.only_first.sum())} cells"
    assert "3 options of the two runs differ." in context["summary"]
    assert "The grids differ: each cell of A is compared with the cell of B that holds its centre." in context["grid"]
    text = "\n".join(comparison_text(comparison))
    assert f"A: {runs[0]}" in text
    assert re.search(r"B less A: median [+-]\d\.\d{3} m, NMAD \d", text)
    assert "options that differ: resolution: 0.5, 0.6; bounds:" in text
    assert "versions that differ: none" in text


def test_a_run_and_itself_are_the_same(runs):
    same = compared_runs(runs[0], runs[0])
    context = page_context(same)
    assert "the heights are the same. Both runs have the same options." in context["summary"]
    assert context["where"] is None
    assert context["options"] == []
    assert context["grid"] == "The cells of A and B lie on each other where both reach, and are compared as they are."
    assert saturated_difference_m(same.differences) == 0.05


@pytest.mark.parametrize("which", [(0, 1), (1, 0)])
def test_a_raster_and_a_run(runs, tmp_path, which):
    pair = [runs[0], runs[1] / "dsm.tif"]
    comparison = compared_runs(*(pair[i] for i in which))
    assert comparison.run_records is None
    text = write_comparison(tmp_path, comparison).read_text(encoding="utf-8")
    assert re.findall(r'<section id="(\w+)"', text) == SECTIONS[:4]
    assert "a raster without a run, so options, times and cameras are not compared" in text
    assert "options that differ" not in "\n".join(comparison_text(comparison))


def test_a_folder_without_a_surface_is_refused(runs, tmp_path):
    (tmp_path / "cloud.laz").touch()
    with pytest.raises(InputError, match="holds a point cloud"):
        compared_runs(runs[0], tmp_path)
    with pytest.raises(InputError, match="nowhere"):
        compared_runs(tmp_path / "nowhere", runs[0])


def test_an_output_that_cannot_be_made(comparison, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot be made"):
        write_comparison(tmp_path / "file" / "out", comparison)


@pytest.mark.parametrize("width", WIDTHS)
def test_a_browser_shows_it_without_scrolling_sideways(comparison, tmp_path, width):
    """Nothing but tables with a hint is wider than the page, and no message is written to the console."""
    browser = found_browser()
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: no page is driven")
    page_path = write_comparison(tmp_path, comparison)
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page, said = chromium.new_page(viewport={"width": width, "height": 900}), []
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(page_path.as_uri())
        inner = page.evaluate("document.documentElement.scrollWidth")
        broken = page.evaluate("[...document.images].filter(i => !i.complete || !i.naturalWidth).length")
        chromium.close()
    assert inner <= width
    assert broken == 0
    assert said == []
