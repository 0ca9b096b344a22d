"""Pictures of the inspector, taken in a browser: `python docs/inspector_pictures.py [FOLDER]`.

Renders the scene of the demo, makes its surface, and opens it in the inspector beside its truth. Needs Chromium: the
program that CHROMIUM names, or one on the PATH.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

HERE = Path(__file__).parent
ZLOCUS = Path(sys.executable).with_name("zlocus")
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SIZE = {"width": 1360, "height": 1000}
WAIT_MS = 120_000
# All of the surface at the start; a cell by a house, which three images do not see; all of the middle from the south.
VIEWS = {
    "inspect_map.png": "layers=hillshade:1,above:0.6",
    "inspect_cell.png": "at=462051,5246930,1.9&cell=462049,5246930&layers=hillshade:1,height:0.55&tab=cell&weighed=1",
    "inspect_relief.png": "at=462049,5246940,0.75&layers=hillshade:1,ortho:0.5,sigma:0.5&tab=relief"
    "&eye=-0.35,0.75,0.95,0,-0.02,0.03",
}


def main() -> None:
    """Make the surface and take the pictures."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "pictures"
    browser = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        sys.exit(f"There is no browser: set CHROMIUM, or install one of {', '.join(BROWSERS)}.")
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "demo"
        for command in (["demo", "-o", out], ["products", out, "--products", "dtm"]):
            subprocess.run([ZLOCUS, *command], check=True, stdout=subprocess.DEVNULL)
        words = [ZLOCUS, "inspect", out, "--reference", out / "scene" / "truth_dsm.tif"]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            try:
                take(server.stdout.readline().strip(), browser, folder)
            finally:
                server.terminate()


def take(address: str, browser: str, folder: Path) -> None:
    """Write a picture of every view of a page."""
    with sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        chromium = playwright.chromium.launch(executable_path=browser, args=arguments)
        for name, view in VIEWS.items():
            page = chromium.new_context(viewport=SIZE, color_scheme="light").new_page()
            page.set_default_timeout(WAIT_MS)
            page.goto(f"{address}#{view}")
            page.wait_for_selector('body[data-ready="true"][data-scene="ready"]')
            page.wait_for_selector("#layer-difference", state="attached")
            prepare(page, view)
            (folder / name).write_bytes(page.screenshot())
        chromium.close()


def prepare(page: Any, view: str) -> None:
    """Wait until a view is drawn, and scroll to the part that the picture shows."""
    if "tab=relief" in view:
        page.wait_for_selector("#relief-view[data-places]")
    elif "tab=cell" in view:
        page.wait_for_selector('#match:not([hidden])[aria-busy="false"]')
        page.wait_for_selector("#costs-figure svg")
    page.wait_for_timeout(1500)


if __name__ == "__main__":
    main()
