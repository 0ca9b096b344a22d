"""Rows of the acceptance table on the inspector: response times of clicks and of tiles of the map.

    python benchmarks/inspecting.py OUT [--bar-ms N] [--clicks N] [--tiles N]

OUT holds a surface of `zlocus dsm`. All clicks are answered by the server. Half of them are also drawn by the page, if
there is a browser (named by CHROMIUM, or on the PATH).
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np
import rasterio
from rasterio.windows import Window

import large
from workplace import ZLOCUS, CannotRun, Figure, Workplace, ended, run

N_CLICKS, N_TILES = 60, 200
DEMO_MS, LARGE_MS, LARGE_M = 300.0, 1000.0, 100.0
OPENED_S = 300.0
SLOW = "a click reads whole rasters or images, or the page draws everything anew"
SIZE = {"width": 1280, "height": 860}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# Measures the time from a click to the frame in which the whole cell is drawn.
CLOCK = """() => {
  window.drawnAfter = null;
  document.getElementById("map").addEventListener("pointerup", () => (window.clickedAt = performance.now()),
    { once: true, capture: true });
  document.addEventListener("looked", () => requestAnimationFrame(() => setTimeout(() => {
    window.drawnAfter = performance.now() - window.clickedAt;
  })), { once: true });
}"""


def inspect(workplace: Workplace) -> list[Figure]:
    """Response times on the demo."""
    run([ZLOCUS, "demo", "-o", workplace.out])
    return measured(workplace.out, DEMO_MS)


def inspect_large(workplace: Workplace) -> list[Figure]:
    """Response times on a surface of 100 million cells."""
    with tempfile.TemporaryDirectory(dir=workplace.out.parent) as scratch:
        images = large.write_views(Path(scratch), large.town(), 6, round((LARGE_M * 1e6) ** 0.5))
        run([ZLOCUS, "dsm", *images, "-o", workplace.out, "--crs", "EPSG:32632", "--resolution", 0.5, "--overwrite"])
        return measured(workplace.out, LARGE_MS)


def measured(out: Path, bar_ms: float, n_clicks: int = N_CLICKS, n_tiles: int = N_TILES) -> list[Figure]:
    """Response times of clicks at random cells with a height, and of map tiles of all levels, one after the other.

    n_clicks : answered by the server; the browser draws half of them.
    """
    with served(out) as address, httpx.Client(base_url=address, timeout=60) as client:
        about = client.get("api/surface").json()
        cells = list(places(out, n_clicks))
        clicks = [timed(client, "api/cell", {"x": x, "y": y}) for x, y in cells]
        tiles = [timed(client, path) for path in tile_paths(about, n_tiles)]
        drawn = drawn_ms(address, cells[: n_clicks // 2])
    million = about["shape"][0] * about["shape"][1] / 1e6
    figures = [
        Figure("million cells", million),
        Figure("a click answered, median", float(np.median(clicks)), "ms", at_most=bar_ms, fails_when=SLOW),
        Figure(f"a click answered, slowest of {n_clicks}", max(clicks), "ms", at_most=bar_ms, fails_when=SLOW),
        Figure("a tile of the map, median", float(np.median(tiles)), "ms"),
        Figure(f"a tile of the map, slowest of {n_tiles}", max(tiles), "ms"),
    ]
    if drawn:
        figures += [
            Figure("a click drawn, median", float(np.median(drawn)), "ms", at_most=bar_ms, fails_when=SLOW),
            Figure(f"a click drawn, nine in ten of {n_clicks // 2}", float(np.percentile(drawn, 90)), "ms"),
        ]
    return figures


@contextmanager
def served(out: Path) -> Iterator[str]:
    """Serve a surface, and give the address of the page once the scene is open."""
    with subprocess.Popen([str(ZLOCUS), "inspect", str(out)], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            end = time.monotonic() + OPENED_S
            while (state := httpx.get(f"{address}api/state").json()["scene"])["is"] == "opening":
                if time.monotonic() > end:
                    raise CannotRun(f"{out} does not open")
                time.sleep(0.2)
            if state["is"] != "ready":
                raise CannotRun(state["why"])
            yield address
        finally:
            process.terminate()


def places(out: Path, n: int) -> Iterator[tuple[float, float]]:
    """Centres (x, y) m of random cells that have a height."""
    rng, found = np.random.default_rng(11), 0
    with rasterio.open(out / "dsm.tif") as file:
        while found < n:
            row, col = int(rng.integers(file.height)), int(rng.integers(file.width))
            if np.isfinite(file.read(1, window=Window(col, row, 1, 1))[0, 0]):
                found += 1
                yield file.transform * (col + 0.5, row + 0.5)


def tile_paths(about: dict, n: int) -> Iterator[str]:
    """Addresses of random map tiles of random layers and levels."""
    rng, names = np.random.default_rng(12), [layer["name"] for layer in about["layers"]]
    for _ in range(n):
        level = int(rng.integers(about["levels"] + 1))
        rows, cols = (-(-side // (256 << level)) for side in about["shape"])
        yield f"tiles/{rng.choice(names)}/{level}/{rng.integers(cols)}/{rng.integers(rows)}.png"


def timed(client: httpx.Client, path: str, query: dict[str, float] | None = None) -> float:
    """Time of an answer, ms."""
    start = time.perf_counter()
    client.get(path, params=query).raise_for_status()
    return 1e3 * (time.perf_counter() - start)


def drawn_ms(address: str, cells: list[tuple[float, float]]) -> list[float]:
    """Times from clicks to complete drawings of the cells, ms; empty without a browser.

    The first click does not count, because the browser compiles the scripts of the page for it.
    """
    browser = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        return []
    from playwright.sync_api import sync_playwright

    found = []
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page = chromium.new_context(viewport=SIZE).new_page()
        page.goto(address)
        page.wait_for_selector('body[data-ready="true"][data-scene="ready"]')
        box = page.locator("#map").bounding_box()
        assert box is not None
        for x, y in cells:
            page.evaluate(f"location.hash = '#at={x},{y},1'")
            page.wait_for_timeout(1000)  # its tiles
            page.evaluate(CLOCK)
            page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
            while (after := page.evaluate("window.drawnAfter")) is None:
                page.wait_for_timeout(20)
            found.append(after)
        chromium.close()
    return found[1:]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--bar-ms", type=float, default=DEMO_MS)
    parser.add_argument("--clicks", type=int, default=N_CLICKS, metavar="N", help="cells that are clicked")
    parser.add_argument("--tiles", type=int, default=N_TILES, metavar="N", help="tiles of the map that are asked for")
    options = parser.parse_args()
    for figure in measured(options.out, options.bar_ms, options.clicks, options.tiles):
        print("  ".join(figure.cells()))


if __name__ == "__main__":
    ended(main)
