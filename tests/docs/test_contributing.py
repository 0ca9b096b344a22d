"""The three examples of docs/development/contributing.md, taken from the page, applied to the package and run.

The files of an example lie in a folder that the packages search first, so that the installed package and its compiled
kernels are used for everything that the example does not change.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from places import ROOT
from rendered_scenes import CENTRE, HEIGHTS, PART, camera, rendered
from rpc_fixtures import write_image
from zlocus.core.jit import CACHE
from zlocus.synthetic.terrain import analytic_height

PAGE = ROOT / "docs" / "development" / "contributing.md"
PACKAGE = ROOT / "src" / "zlocus"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
PATH = re.compile(r"`src/zlocus/([\w/]+\.py)`")
# Run before the code of a test: the packages look into the folder of the example first.
PRELUDE = """
import importlib, sys
from pathlib import Path

overlay = Path(sys.argv[1])
for folder in sorted({path.parent for path in overlay.rglob("*.py")}):
    name = ".".join(("zlocus", *folder.relative_to(overlay).parts))
    importlib.import_module(name).__path__.insert(0, str(folder))
"""


@dataclass(frozen=True)
class Example:
    """files : new content of files, by path in the package; yaml : the scene file that the section shows, or ""."""

    files: dict[str, str]
    yaml: str


def changed(text: str, diff: str) -> str:
    """A text after a change in the form of `diff`, whose old lines it holds once."""
    old = "".join(line[1:] + "\n" for line in diff.splitlines() if line[0] in " -")
    new = "".join(line[1:] + "\n" for line in diff.splitlines() if line[0] in " +")
    assert text.count(old) == 1, f"the page changes lines that are not in the code:\n{old}"
    return text.replace(old, new)


def example(title: str) -> Example:
    """The example of a section: its new files, and the files that it changes."""
    page = PAGE.read_text(encoding="utf-8")
    (section,) = re.findall(rf"^## {title}\n.*?(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
    files: dict[str, str] = {}
    yaml, path, end = "", "", 0
    for block in BLOCK.finditer(section):
        named = PATH.findall(section[end : block.start()].rstrip().rpartition("\n\n")[2])
        path = named[-1] if named else path
        end = block.end()
        language, text = block.groups()
        if language == "yaml":
            yaml = text
        elif language == "python":
            assert not (PACKAGE / path).exists(), f"{path} is said to be new"
            files[path] = text
        else:
            before = files[path] if path in files else (PACKAGE / path).read_text(encoding="utf-8")
            files[path] = changed(before, text)
    return Example(files, yaml)


def run(title: str, code: str, folder: Path) -> str:
    """What some code prints that runs in a folder with the example of a section applied."""
    overlay = folder / "overlay"
    for path, text in example(title).files.items():
        (overlay / path).parent.mkdir(parents=True, exist_ok=True)
        (overlay / path).write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", PRELUDE + code, overlay], cwd=folder, capture_output=True, text=True,
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"} | own_kernels(folder / "kernels"),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def own_kernels(folder: Path) -> dict[str, str]:
    """Environment of a process that keeps kernels in a folder of its own, where those of the package lie already, and
    compiles the others without optimisation, in half the time."""
    if CACHE.folder is not None and CACHE.folder.exists():
        shutil.copytree(CACHE.folder, folder / CACHE.folder.name)
    return {"NUMBA_CACHE_DIR": str(folder), "NUMBA_OPT": "0"}


@pytest.mark.parametrize(("title", "n_files"), [("Add a sensor", 3), ("Add a matching cost", 2), ("Add a product", 4)])
def test_an_example_changes_few_files(title, n_files):
    assert len(example(title).files) == n_files


def test_a_change_of_lines_that_are_not_there_is_noticed():
    assert changed("a\nb\n", " a\n-b\n+c\n") == "a\nc\n"
    with pytest.raises(AssertionError, match="not in the code"):
        changed("a\n", "-b\n+c\n")


def test_a_sensor_can_be_added(tmp_path):
    (tmp_path / "scene.yaml").write_text(example("Add a sensor").yaml, encoding="utf-8")
    for name, tilt in (("left", 0.3), ("right", -0.3)):
        write_image(tmp_path / f"{name}.tif", np.random.default_rng(1).integers(1, 1000, (30, 40), np.uint16))
        (tmp_path / f"{name}.txt").write_text(f"2.0 0.0 {tilt} 0.0 -2.0 0.0 {CENTRE[0]} {CENTRE[1]} 50.0 20.0 15.0\n")
    printed = run(
        "Add a sensor",
        """
import numpy as np
import zlocus

scene = zlocus.open_scene("scene.yaml")
xyz = np.array([[462004.0, 5247003.0, 60.0]])
for view in scene.views:
    xy = view.sensor.image_from_ground(xyz)
    assert np.allclose(view.sensor.ground_from_image(xy, xyz[:, 2]), xyz)
    print(view.name, *xy[0].round(6))
""",
        tmp_path,
    )
    assert printed.splitlines() == ["left 31.0 9.0", "right 25.0 9.0"]


def parallel_numbers(name: str) -> str:
    """The file of the page's camera that fits a rendered view best; it is off by less than 0.01 px."""
    east, north, up = np.meshgrid(np.linspace(-45.0, 45.0, 5), np.linspace(-45.0, 45.0, 5), np.linspace(*HEIGHTS, 4))
    xyz = np.column_stack([east.ravel() + CENTRE[0], north.ravel() + CENTRE[1], up.ravel()])
    centre = np.array([*CENTRE, 50.0])
    terms = np.column_stack([xyz - centre, np.ones(len(xyz))])
    coefficients = np.linalg.lstsq(terms, camera(name).image_from_ground(xyz), rcond=None)[0]
    return " ".join(map(str, (*coefficients[:3].T.ravel(), *centre, *coefficients[3])))


def test_a_scene_of_the_sensor_is_matched(tmp_path):
    """With the scene file of the page, as it stands."""
    scene_file, images = example("Add a sensor").yaml, rendered(tmp_path / "rendered", "sine")
    (tmp_path / "scene.yaml").write_text(scene_file, encoding="utf-8")
    for name, view in (("left", "fore"), ("right", "aft")):
        images.paths[view].rename(tmp_path / f"{name}.tif")
        (tmp_path / f"{name}.txt").write_text(parallel_numbers(view), encoding="utf-8")
    code = f"""
import numpy as np
import zlocus

surface = zlocus.match("scene.yaml", resolution=0.5, bounds={PART})
np.savez("surface.npz", x=surface.x, y=surface.y, height=surface.height)
"""
    run("Add a sensor", code, tmp_path)
    surface = np.load(tmp_path / "surface.npz")
    truth = analytic_height("sine", *np.meshgrid(surface["x"] - CENTRE[0], surface["y"] - CENTRE[1]))
    error = np.abs(surface["height"] - truth)
    assert np.isfinite(error).mean() > 0.9
    assert np.nanmedian(error) < 0.1


def test_a_sensor_that_cannot_be_read_is_refused(tmp_path):
    printed = run(
        "Add a sensor",
        """
from zlocus.core.errors import InputError
from zlocus.io.cameras.camera_kinds import CAMERA_KINDS

Path("cut.txt").write_text("1.0 2.0\\n")
try:
    CAMERA_KINDS["parallel"](file="cut.txt").read(Path(), Path("image.tif"))
except InputError as error:
    print(error)
""",
        tmp_path,
    )
    assert printed == "cut.txt holds 2 numbers, not 11. Correct the file.\n"


def test_a_matching_cost_can_be_added(tmp_path):
    images = rendered(tmp_path / "rendered", "sine")
    bounds = (CENTRE[0] - 10, CENTRE[1] - 10, CENTRE[0] + 10, CENTRE[1] + 10)
    code = f"""
import zlocus
from zlocus.matching.kernels import cost_volume

assert hasattr(cost_volume, "add_positive_pairs")
surface = zlocus.match(*{list(map(str, images.inputs))!r}, resolution=0.5, bounds={bounds}, heights={HEIGHTS})
print(float(surface.height.notnull().mean()))
"""
    assert float(run("Add a matching cost", code, tmp_path)) > 0.9


def test_a_product_can_be_added(tmp_path):
    heights = np.full((4, 5), 12.5, np.float32)
    heights[0, 0], heights[1] = np.nan, 13.25
    with rasterio.open(
        tmp_path / "dsm.tif", "w", driver="GTiff", width=5, height=4, count=1, dtype="float32", crs="EPSG:32632",
        transform=from_origin(*CENTRE, 0.5, 0.5), nodata=np.nan,
    ) as file:  # fmt: skip
        file.write(heights, 1)
    run(
        "Add a product",
        """
from zlocus.core.options import ProductOptions
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import product_names
from zlocus.products.derived import write_derived
from zlocus.products.stac_item import PRODUCTS

assert "height_counts.csv" in {product.name for product in PRODUCTS}
write_derived(Path(), product_names("height_counts"), ProductOptions(), SilentProgress())
""",
        tmp_path,
    )
    assert (tmp_path / "height_counts.csv").read_text() == "height_m,cells\n12,14\n13,5\n"
