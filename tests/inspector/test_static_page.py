"""The inspector's page as somebody uses it, in a browser that nobody sees."""

from __future__ import annotations

import json
import re
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from browser import found_browser
from inspected import a_cell, served
from rendered_scenes import CENTRE, SMALL_TILES, run
from zlocus.evaluation.comparison import Comparison
from zlocus.inspector.cell import WhatIf
from zlocus.inspector.restored_run import restored
from zlocus.matching.point_match import curves_at
from zlocus.pipeline.report_inputs import SHOWN_WITHIN_CELLS, place_of_cell
from zlocus.products.point_report import LABELS, PointReport

LAYERS = ["hillshade", "ortho", "height", "sigma", "views", "quality", "dtm", "above", "difference"]
DESK, PHONE = {"width": 1280, "height": 860}, {"width": 390, "height": 844}
WAIT_MS = 30_000
# What the page rounds: correlations to 4 digits, ratios to 3, heights to 2.
SHOWN_RHO, SHOWN_RATIO, SHOWN_M = 5.1e-5, 5.1e-4, 5.1e-3
REFERENCE_M = 0.25
LEAST_TARGET_PX = 36
# Height of a legend of colours that run, below a saved map.
LEGEND_PX = 62
# Beside the surface, where the map shows all of it.
MARGIN_PX = 10


@pytest.fixture(scope="module")
def out(images, tmp_path_factory):
    """A run over all of the sine; not to be changed."""
    out = tmp_path_factory.mktemp("page") / "out"
    return run(images("sine"), out, SMALL_TILES, report=True, products=("hillshade", "dtm")).out


@pytest.fixture(scope="module")
def inspected(out, tmp_path_factory):
    """The inspection with a reference, and its address."""
    reference = tmp_path_factory.mktemp("reference") / "reference.tif"
    with rasterio.open(out / "dsm.tif") as file:
        z, profile, above = file.read(1), file.profile, file.descriptions[0]
    with rasterio.open(reference, "w", **{**profile, "driver": "GTiff"}) as file:
        file.write(z + np.float32(REFERENCE_M), 1)
        file.set_band_description(1, above)
    with served(out, Comparison(reference, margin_m=0.0)) as found:
        yield found


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: no page is driven")
    path = found_browser()
    with sync_api.sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        chromium = playwright.chromium.launch(executable_path=path, args=arguments)
        yield chromium
        chromium.close()


@pytest.fixture
def page(browser, inspected):
    """The page, open; a message of the browser, an answer that is an error, or a question to others fail the test."""
    opened, faults = page_at(browser, inspected[1], DESK)
    yield opened
    opened.context.close()
    assert faults == []


def page_at(browser, address, size, **options):
    context = browser.new_context(viewport=size, accept_downloads=True, **options)
    page, faults = context.new_page(), []
    page.set_default_timeout(WAIT_MS)
    page.on("console", lambda message: faults.append(message.text) if message.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("response", lambda answer: faults.append(f"{answer.status} {answer.url}") if answer.status >= 400 else None)
    origin = address[: address.index("/", 8)]
    page.on(
        "request", lambda asked: None if asked.url.startswith((origin, "data:", "blob:")) else faults.append(asked.url)
    )
    page.goto(address)
    page.wait_for_selector('body[data-ready="true"][data-scene="ready"]')
    page.wait_for_selector("#layer-difference", state="attached")
    return page, faults


def link_of(page) -> str:
    """The link of the view that the page shows now."""
    return page.evaluate('async () => (await import(new URL("static/js/state.js", document.baseURI))).link()')


def match_scene(page) -> None:
    """Wait for the curves of the cell that was asked for."""
    page.wait_for_selector('#match:not([hidden])[aria-busy="false"]')


def open_address(page, part) -> None:
    """Set the part of the address behind #, and wait until the page has followed it."""
    page.evaluate(
        """(part) => new Promise((done) => {
             if (location.hash === part) return done();
             addEventListener("hashchange", () => done(), { once: true });
             location.hash = part;
           })""",
        part,
    )


def click_cell(page, folder, row, col) -> None:
    """Click the middle of a cell where the map shows it."""
    x, y = folder.centre_of(row, col)
    # One pixel of the map is a cell then, and the cell's middle the map's.
    open_address(page, f"#at={x},{y},2")
    box = page.locator("#map").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.wait_for_selector(f"text=Cell at row {row}, column {col}")
    match_scene(page)


def report_of(out, folder, row, col, without=(), window=None) -> PointReport:
    """What the library says of the cell."""
    scene = restored(out, folder.run)
    config, matching = scene.config, scene.run.match_scene
    if window is not None:
        config = replace(config, cost=replace(config.cost, large_window=window))
    kept = [i for i, view in enumerate(matching.views) if view.name not in without]
    views, scales = (tuple(each[i] for i in kept) for each in (matching.views, matching.grey_scales))
    matching = replace(matching, views=views, grey_scales=scales)
    place = place_of_cell(folder.centre_of(row, col), folder.cell(row, col)["dsm"], scene.run)
    looked = curves_at("the cell", None, matching, place, config, SHOWN_WITHIN_CELLS)
    return PointReport.of("the cell", looked, matching, scene.run.scene.crs)


def number(text: str) -> float:
    return float(re.search(r"[-+−]?\d+(\.\d+)?", text)[0].replace("−", "-"))


def shown_table(page) -> dict[str, dict[str, str]]:
    """The table of images: what stands in each cell that holds a value, by image."""
    return page.evaluate(
        """() => Object.fromEntries([...document.querySelectorAll("#images tr[data-image]")].map((row) => {
            const cells = [...row.querySelectorAll("[data-value]")];
            return [row.dataset.image, Object.fromEntries(cells.map((td) => [td.dataset.value, td.textContent]))];
        }))"""
    )


def agrees(table, report: PointReport) -> None:
    """The numbers shown are the library's, rounded."""
    single, mean = report.curves.single_curves, report.curves.mean_curves
    for j, name in enumerate(report.search):
        row = table[name]
        assert row["label"] == LABELS[single.labels[j]]
        assert row["mean"] == LABELS[mean.labels[j]]
        assert number(row["rho1"]) == pytest.approx(single.peaks.rho1[j], abs=SHOWN_RHO)
        if np.isfinite(single.peaks.ratio[j]):
            assert number(row["ratio"]) == pytest.approx(single.peaks.ratio[j], abs=SHOWN_RATIO)
        assert number(row["peak"]) == pytest.approx(report.heights_m[single.peaks.peak[j]], abs=SHOWN_M)


@pytest.mark.parametrize("size", [DESK, PHONE])
def test_the_map_fills_the_window_at_the_start_and_when_it_changes(browser, inspected, size):
    page, faults = page_at(browser, inspected[1], size)
    assert page.locator("#panel").is_hidden()
    fills(page, inspected[0])
    # A smaller window, of another shape.
    page.set_viewport_size({"width": size["width"], "height": size["height"] - 250})
    page.wait_for_timeout(300)
    fills(page, inspected[0])
    assert "at=" not in link_of(page)
    # Another place stays where it is.
    page.locator("#map").focus()
    page.keyboard.press("+")
    page.wait_for_timeout(500)
    at = re.search("at=[^&]*", link_of(page))[0]
    page.set_viewport_size(size)
    page.wait_for_timeout(300)
    assert re.search("at=[^&]*", link_of(page))[0] == at
    page.context.close()
    assert faults == []


def fills(page, inspection) -> None:
    """The map takes all below the header, and the surface fills it up to the legend and the list in one direction."""
    window = page.evaluate("[innerWidth, innerHeight]")
    box = page.locator("#map").bounding_box()
    assert box["width"] == window[0]
    assert box["y"] + box["height"] == pytest.approx(window[1], abs=1)
    assert page.evaluate("document.documentElement.scrollHeight") <= window[1] + 1
    legend = page.locator("#legends").bounding_box()
    assert page.locator("#legends .legend:visible").count() == 1
    top, left, bottom, right = inspection.summary()["extent"]
    scale = page.evaluate("""async () => (await import(new URL("static/js/map.js", document.baseURI))).patch(1000)""")
    px = box["width"] / scale["cols"]
    width, height = px * (right - left), px * (bottom - top)
    is_phone = box["width"] < 500
    room = (
        box["width"] - (0 if is_phone else box["width"] - page.locator("#layers").bounding_box()["x"]) - 2 * MARGIN_PX,
        (legend["y"] if is_phone else box["y"] + box["height"]) - box["y"] - 2 * MARGIN_PX,
    )
    assert max(width / room[0], height / room[1]) == pytest.approx(1.0, abs=0.02)


def test_the_page_tells_of_images_and_costs_what_the_library_tells(page, inspected, out):
    folder, (row, col) = inspected[0].folder, a_cell(out)
    click_cell(page, folder, row, col)
    record = inspected[0].cell(*folder.centre_of(row, col), WhatIf())
    assert page.locator("#accounts-say").inner_text() == record["accounts_say"]
    assert page.locator("#accounts li").all_inner_texts() == [account["says"] for account in record["accounts"]]
    assert page.locator("#ties-say").inner_text() == record["match"]["neighbours"]["says"]
    page.locator("#matcher summary").click()
    page.wait_for_selector("#costs-figure svg")
    weighed = inspected[0].matcher(*folder.centre_of(row, col))
    assert page.locator("#matcher-says li").all_inner_texts() == weighed["says"]
    assert "weighed=1" in link_of(page)
    page.locator("#close").click()
    assert page.locator("#panel").is_hidden()
    assert page.locator("#map").bounding_box()["width"] == DESK["width"]


def test_a_saved_figure_tells_what_became_of_the_images(page, inspected, out, tmp_path):
    click_cell(page, inspected[0].folder, *a_cell(out))
    button = page.locator("#windows-figure").get_by_role("button", name="SVG")
    text = re.sub(r"<[^>]*>", " ", saved(page, button, tmp_path).decode())
    said = page.locator("#accounts li").first.inner_text()
    assert " ".join(said.split()) in " ".join(text.split())


def test_every_layer_can_be_switched_and_made_fainter(page):
    for name in LAYERS:
        box, shown = page.locator(f"#layer-{name}"), page.locator(f".leaflet-layer.layer-{name}")
        box.check()
        page.wait_for_selector(f".layer-{name} img.leaflet-tile-loaded", state="attached")
        share = page.locator(f".layer:has(#layer-{name}) input[type=range]")
        share.fill("0.4")
        assert float(shown.evaluate("layer => layer.style.opacity")) == pytest.approx(0.4)
        assert f"{name}%3A0.4" in link_of(page)
        box.uncheck()
        assert shown.count() == 0
    page.locator("#layer-height").check()
    assert "height above the ellipsoid, m" in page.locator(".legend:visible").inner_text()
    assert page.locator(".leaflet-control-scale-line").inner_text().endswith(" m")


def test_a_click_shows_the_librarys_numbers(page, inspected, out):
    folder, (row, col) = inspected[0].folder, a_cell(out)
    click_cell(page, folder, row, col)
    cell, report = folder.cell(row, col), report_of(out, folder, row, col)
    assert number(page.locator("#cell-height").inner_text()) == pytest.approx(cell["dsm"], abs=SHOWN_M)
    assert number(page.locator("#cell-sigma").inner_text()) == pytest.approx(cell["sigma"], abs=5.1e-4)
    assert number(page.locator("#cell-images").inner_text()) == cell["views"]
    assert number(page.locator("#cell-difference").inner_text()) == pytest.approx(-REFERENCE_M, abs=SHOWN_M)
    agrees(shown_table(page), report)
    stop = page.locator("#match-stop").inner_text()
    assert f" {report.curves.n_used} of {len(report.search)} search images" in stop
    assert f"{report.peak_m:.3f} m" in stop
    assert page.locator("#images tr.last").get_attribute("data-image") == report.search[report.curves.n_used - 1]
    # The cell, the circle around it and a mark for each tie point are on the map.
    n_ties = len(report.curves.order.features)
    assert page.locator("#map path.leaflet-interactive").count() == n_ties
    # Their head, a dozen of them, and how many more there are.
    assert page.locator("#ties tr").count() == min(n_ties, 12) + 1 + (n_ties > 12)


def test_the_slider_moves_all_that_shows_a_height(page, inspected, out):
    folder, (row, col) = inspected[0].folder, a_cell(out)
    click_cell(page, folder, row, col)
    report = report_of(out, folder, row, col)
    middle = len(report.heights_m) // 2
    fixed, moving = ("#windows-figure image.fixed", "#windows-figure image.moving")
    pictures = "nodes => nodes.map((node) => node.getAttribute('href'))"
    before = page.eval_on_selector_all(fixed, pictures)
    assert page.eval_on_selector_all(moving, pictures) == before
    line = "#ncc-figure line.selected-height"
    at = float(page.locator(line).get_attribute("x1"))
    circles = "nodes => nodes.map((node) => node.getAttribute('transform'))"
    places = page.eval_on_selector_all("#loci-figure circle.selected-height", circles)
    shown = page.locator("#height-value").inner_text()
    page.locator("#height").fill(str(middle + 9))
    # All is drawn again with the next frame.
    page.wait_for_function("text => document.getElementById('height-value').textContent !== text", arg=shown)
    height = report.heights_m[middle + 9]
    assert number(page.locator("#height-value").inner_text()) == pytest.approx(height, abs=SHOWN_M)
    assert page.eval_on_selector_all(fixed, pictures) == before
    moved = page.eval_on_selector_all(moving, pictures)
    assert all(one != other for one, other in zip(moved, before, strict=True))
    assert float(page.locator(line).get_attribute("x1")) > at
    assert page.eval_on_selector_all("#loci-figure circle.selected-height", circles) != places
    said = page.locator("#windows-figure text.moving-value").nth(1).text_content()
    assert said == f"{height:.2f} m: ρ {report.curves.single_curves.values[0, middle + 9]:.2f}"


def test_an_image_can_be_switched_off_and_on(page, inspected, out):
    folder, (row, col) = inspected[0].folder, a_cell(out)
    click_cell(page, folder, row, col)
    as_run = shown_table(page)
    off = report_of(out, folder, row, col).search[0]
    page.get_by_label(f"Use {off}").uncheck()
    page.wait_for_selector(f"#images tr[data-image={off}] >> text=switched off")
    match_scene(page)
    assert page.locator("#changed").is_visible()
    agrees(shown_table(page), report_of(out, folder, row, col, without=(off,)))
    page.locator("#reset").click()
    page.wait_for_selector("#changed", state="hidden")
    match_scene(page)
    assert shown_table(page) == as_run


def test_window_and_thresholds_change_the_curves(page, inspected, out):
    folder, (row, col) = inspected[0].folder, a_cell(out)
    click_cell(page, folder, row, col)
    page.locator("#what-if summary").first.click()
    page.locator("#options select[name=window]").select_option("9")
    page.wait_for_selector("#changed", state="visible")
    match_scene(page)
    agrees(shown_table(page), report_of(out, folder, row, col, window=9))
    page.locator("#options input[name=rho1_high]").fill("7")
    page.locator("#options input[name=rho1_high]").dispatch_event("change")
    assert page.locator("#options input[name=rho1_high]").evaluate("input => !input.checkValidity()")
    assert "rho1_high" not in link_of(page)


def test_a_profile_is_drawn_between_two_clicks(page, inspected):
    page.locator("#tab-profile").click()
    box = page.locator("#map").bounding_box()
    for share in (0.35, 0.55):
        page.mouse.click(box["x"] + share * box["width"], box["y"] + 0.5 * box["height"])
    page.wait_for_selector("#profile-figure svg")
    said = page.locator("#profile-text").inner_text()
    ends = [float(part) for part in re.search(r"line=([^&]*)", link_of(page))[1].split("%2C")]
    assert number(said) == pytest.approx(np.hypot(ends[2] - ends[0], ends[3] - ends[1]), abs=0.051)
    assert "one standard deviation to either side. The dashed brown line is the reference. The dotted green" in said
    assert page.locator("#profile-figure svg path").count() >= 3  # band, reference, surface


def test_a_link_reopens_the_view(page, browser, inspected, out):
    folder, (row, col) = inspected[0].folder, a_cell(out)
    click_cell(page, folder, row, col)
    page.locator("#layer-sigma").check()
    page.locator("#height").fill("55")
    page.get_by_label("Use aft").uncheck()
    page.wait_for_selector("#changed", state="visible")
    match_scene(page)
    link = link_of(page)
    other, faults = page_at(browser, link, DESK)
    match_scene(other)
    for what in ("#cell-title", "#height-value", "#match-stop"):
        assert other.locator(what).inner_text() == page.locator(what).inner_text()
    assert other.locator("#layer-sigma").is_checked()
    assert shown_table(other) == shown_table(page)
    assert link_of(other) == link
    other.context.close()
    assert faults == []


def test_an_address_that_is_opened_is_not_overwritten_by_the_one_before(page, inspected):
    # What the map wrote late could otherwise come between the new address and the event that reads it.
    x, y = inspected[0].folder.centre_of(40, 40)
    address = f"#at={x},{y},2"
    page.wait_for_timeout(400)
    page.evaluate(
        """async (address) => {
             const state = await import(new URL("static/js/state.js", document.baseURI));
             state.set({ at: "0,0,0" });
             location.hash = address;
             state.link();
           }""",
        address,
    )
    page.wait_for_timeout(400)
    assert page.url.replace("%2C", ",").endswith(f"#at={x},{y},2")


def test_it_is_used_from_the_keyboard(page, inspected):
    page.locator("#map").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("+")
    page.wait_for_timeout(500)
    assert page.locator("#crosshair").is_visible()
    page.keyboard.press("Enter")
    page.wait_for_selector("#cell-content:not([hidden])")
    match_scene(page)
    before = page.locator("#cell-title").inner_text()
    page.keyboard.press("Shift+ArrowDown")
    row, col = (int(n) for n in re.findall(r"\d+", before))
    page.wait_for_selector(f"text=Cell at row {row + 1}, column {col}")
    match_scene(page)
    height = page.locator("#height-value").inner_text()
    page.keyboard.press("]")
    assert page.locator("#height-value").inner_text() != height
    page.keyboard.press("4")
    assert page.locator("#layer-sigma").is_checked()
    page.keyboard.press("?")
    assert page.locator("#keys").is_visible()
    page.keyboard.press("Escape")
    page.keyboard.press("p")
    page.locator("#map").focus()
    page.keyboard.press("ArrowLeft")
    page.wait_for_timeout(500)
    page.keyboard.press("p")
    page.wait_for_selector("#profile-figure svg")
    page.keyboard.press("d")
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"


def test_figures_and_map_are_saved(page, inspected, out, tmp_path):
    click_cell(page, inspected[0].folder, *a_cell(out))
    for figure in ("ncc", "sncc", "windows", "loci"):
        for kind, start in (("SVG", b"<svg"), ("PNG", b"\x89PNG")):
            content = saved(page, page.locator(f"#{figure}-figure").get_by_role("button", name=kind), tmp_path)
            assert content.startswith(start)
            assert kind == "PNG" or (b"var(--" not in content and b'xmlns="http://www.w3.org/2000/svg"' in content)
    content = saved(page, page.locator("#export-map"), tmp_path)
    width, height = (int.from_bytes(content[at : at + 4], "big") for at in (16, 20))
    box = page.locator("#map").bounding_box()
    assert (width, height) == (round(box["width"]), round(box["height"]) + LEGEND_PX)


def saved(page, button, folder: Path) -> bytes:
    with page.expect_download() as download:
        button.click()
    path = folder / download.value.suggested_filename
    download.value.save_as(path)
    return path.read_bytes()


def test_the_surface_is_shown_in_three_dimensions(page, inspected, tmp_path):
    page.locator("#tab-relief").click()
    page.wait_for_selector("#relief-view[data-places]")
    folder = inspected[0].folder
    with rasterio.open(folder.path("dsm")) as file:
        n_known = int(np.isfinite(file.read(1)).sum())
    assert int(page.locator("#relief-view").get_attribute("data-places")) == pytest.approx(n_known, rel=0.02)
    content = saved(page, page.locator("#export-relief"), tmp_path)
    import cv2

    drawn = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 50  # the ortho-image is on it


def test_a_block_has_plain_walls_and_its_shadow_a_line_to_it(browser, block):
    folder, _ = block
    with served(folder.out) as (_, address):
        x, y = folder.centre_of(*folder.cell_of(CENTRE[0] - 2.25, CENTRE[1] + 0.25))
        page = browser.new_context(viewport=DESK).new_page()
        page.set_default_timeout(WAIT_MS)
        page.goto(f"{address}#tab=relief&cell={x},{y}")
        page.wait_for_selector("#relief-view[data-places]")
        assert int(page.locator("#relief-view").get_attribute("data-walls")) > 100
        bare = pixels_of(page)
        page.locator("#walls").uncheck()
        assert (pixels_of(page) != bare).any()
        page.locator("#tab-cell").click()
        match_scene(page)
        account = page.locator("#accounts li.occluded")
        assert account.count() == 1
        assert account.inner_text().startswith("aft is occluded.")
        # The cell, the circle around it, the ties and, for the occluder, a line with its edge and its end.
        n_ties = page.locator("#map path.leaflet-interactive").count()
        assert page.locator("#map path").count() >= n_ties + 5
        page.context.close()


def pixels_of(page) -> np.ndarray:
    """What the view in three dimensions shows."""
    import cv2

    content = page.locator("#relief-view canvas").screenshot()
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)


@pytest.mark.parametrize(("size", "scheme"), [(DESK, "light"), (DESK, "dark"), (PHONE, "light"), (PHONE, "dark")])
def test_it_fits_laptops_and_telephones_by_day_and_night(browser, inspected, out, size, scheme):
    x, y = inspected[0].folder.centre_of(*a_cell(out))
    page, faults = page_at(browser, f"{inspected[1]}#cell={x},{y}", size, color_scheme=scheme)
    match_scene(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
    paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (int(re.findall(r"\d+", paper)[0]) < 60) == (scheme == "dark")
    # Every control has a name, and a place that a finger meets.
    unnamed = page.evaluate(
        """() => [...document.querySelectorAll("button, select, input")]
            .filter((each) => each.checkVisibility())
            .filter((each) => !(each.labels?.length || each.getAttribute("aria-label") || each.textContent.trim()))
            .map((each) => each.outerHTML)"""
    )
    assert unnamed == []
    if size is PHONE:
        heights = page.evaluate(
            """() => [...document.querySelectorAll("header button, header select")]
                .filter((each) => each.checkVisibility()).map((each) => each.offsetHeight)"""
        )
        assert min(heights) >= LEAST_TARGET_PX
    page.context.close()
    assert faults == []


def test_the_page_is_used_while_the_scene_opens(browser, out, monkeypatch):
    """A link with a cell, a profile and a tab: all but the curves is there at once, and they follow."""
    may_open = threading.Event()

    def slowly(*arguments):
        may_open.wait(WAIT_MS / 1e3)
        return restored(*arguments)

    monkeypatch.setattr("zlocus.inspector.inspection.restored", slowly)
    with served(out, wait=False) as (inspection, address):
        x, y = inspection.folder.centre_of(*a_cell(out))
        context = browser.new_context(viewport=DESK)
        page = context.new_page()
        page.goto(f"{address}#cell={x},{y}&tab=profile&line={x - 9},{y},{x + 9},{y}")
        page.wait_for_selector("#profile-figure svg")
        assert page.locator("#tab-profile").get_attribute("aria-selected") == "true"
        page.locator("#tab-cell").click()
        page.wait_for_selector("text=curves will follow")
        assert page.locator("#cell-height").inner_text() != "none"
        assert "The images are being opened" in page.locator("#notice").inner_text()
        may_open.set()
        match_scene(page)
        assert page.locator("#cell-error").is_hidden()
        assert page.locator("#tab-cell").get_attribute("aria-selected") == "true"
        context.close()


def test_nothing_old_stays_beside_an_error(page, inspected, out):
    folder, (row, col) = inspected[0].folder, a_cell(out)
    click_cell(page, folder, row, col)
    for name in ("fore", "aft"):
        page.get_by_label(f"Use {name}").uncheck()
        page.wait_for_timeout(300)
    page.wait_for_selector("text=At least two images are needed")
    assert page.locator("#match").is_hidden()
    page.locator("#reset").click()
    match_scene(page)
    assert page.locator("#cell-error").is_hidden()


def test_a_wrong_link_is_said(browser, inspected):
    page, faults = page_at(browser, f"{inspected[1]}#cell=1,2&line=a,b&at=x", DESK)
    page.wait_for_selector("#cell-error:not([hidden])")
    assert page.locator("#cell-error").inner_text() == "The point lies outside the surface."
    page.context.close()
    assert [fault for fault in faults if "404" not in fault] == []


def test_names_that_are_code_do_not_run(images, browser, tmp_path):
    out = run(images("plane"), tmp_path / "out", SMALL_TILES, report=True).out
    record = json.loads((out / "run.json").read_text())
    bad = "<img src=x onerror=alert(1)>"
    record["orientation"]["views"] = {bad: {}, **record["orientation"]["views"]}
    (out / "run.json").write_text(json.dumps(record))
    curves = json.loads((out / "curves.json").read_text())
    curves["cells"][0]["why"] = bad
    (out / "curves.json").write_text(json.dumps(curves))
    with served(out) as (inspection, address):
        x, y = inspection.folder.centre_of(*a_cell(out))
        context = browser.new_context(viewport=DESK)
        page, asked = context.new_page(), []
        page.on("dialog", lambda dialog: asked.append(dialog.message))
        page.on("console", lambda message: asked.append(message.text))
        page.goto(f"{address}#cell={x},{y}")
        match_scene(page)
        page.locator("#others summary").click()
        page.wait_for_selector("#other-images tr")
        assert bad in page.locator("#other-images").inner_text()
        assert bad in page.locator("#go").inner_text()
        assert page.locator("img[src=x]").count() == 0
        assert asked == []
        context.close()
