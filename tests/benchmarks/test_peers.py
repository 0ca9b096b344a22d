"""The comparison with other programs: measuring, what they are given, what is made of their results, the page.

The programs themselves are not installed here: what stands for them writes what their documents say they write.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from peers import builds, cars, environments, isd, matchers, measuring, page, running, scenes
from peers.results import Results
from places import ROOT
from rendered_scenes import CENTRE, HEIGHTS, rendered
from zlocus.io.cameras.rpc_text import read_rpc_txt
from zlocus.synthetic.terrain import analytic_height

CORE = min(os.sched_getaffinity(0))
# Seconds of CPU that a process burns, and what else a Python takes to start and end.
BURNT_S, STARTED_S = 1.0, 1.5
# A surface matched in windows of 3 x 3 on images of half a metre, and how much of it may be false.
PRECISE_M, FALSE_SHARE = 0.6, 0.05
BURN = f"import time; until = time.process_time() + {BURNT_S}\nwhile time.process_time() < until: pass"


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    return rendered(tmp_path_factory.mktemp("images"), "sine")


@pytest.fixture
def scene(images, tmp_path):
    half, step = 25.0, 0.5
    bounds = (CENTRE[0] - half, CENTRE[1] - half, CENTRE[0] + half, CENTRE[1] + half)
    truth = tmp_path / "truth.tif"
    n = round(2 * half / step)
    at = (np.arange(n) + 0.5) * step - half
    write(truth, analytic_height("sine", *np.meshgrid(at, -at)), bounds[0], bounds[3], step)
    with rasterio.open(truth) as file:
        terrain = scenes.write_terrain(file.read(1), file.transform, "EPSG:32632", tmp_path / "terrain.tif")
    return scenes.Scene("sine, 3 views", "city", images.paths, "EPSG:32632", bounds, HEIGHTS, terrain, truth)


def write(path: Path, heights: np.ndarray, west: float, north: float, step: float) -> None:
    with rasterio.open(
        path, "w", driver="GTiff", height=heights.shape[0], width=heights.shape[1], count=1, dtype="float32",
        crs="EPSG:32632", transform=from_origin(west, north, step, step),
    ) as file:  # fmt: skip
        file.write(heights.astype(np.float32), 1)


def program(folder: Path, text: str) -> Path:
    """A command that stands for a program."""
    path = folder / "program"
    path.write_text(f"#!{sys.executable}\n{textwrap.dedent(text)}", encoding="utf-8")
    path.chmod(0o755)
    return path


def test_all_that_is_started_counts(tmp_path):
    """Also what a command leaves behind when it ends, and what that has started."""
    deeper = f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', {BURN!r}])"
    command = [sys.executable, "-c", f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', {deeper!r}])"]
    used = measuring.measured(command, (CORE,), tmp_path / "log")
    assert BURNT_S <= used.cpu_s <= BURNT_S + STARTED_S


def test_memory_is_that_of_all_processes_together(tmp_path):
    hold = "import time; held = bytearray(200 * 2**20); time.sleep(1.5)"
    command = f"import subprocess, sys; c = [sys.executable, '-c', {hold!r}]; p = subprocess.Popen(c); {hold}; p.wait()"
    used = measuring.measured([sys.executable, "-c", command], (CORE,), tmp_path / "log")
    assert 0.39 <= used.peak_gb <= 0.5


def test_a_command_keeps_to_its_cores_and_threads(tmp_path):
    ask = "import os; print(sorted(os.sched_getaffinity(0)), os.environ['OMP_NUM_THREADS'])"
    measuring.measured([sys.executable, "-c", ask], (CORE,), tmp_path / "log")
    assert (tmp_path / "log").read_text() == f"[{CORE}] 1\n"


def test_other_work_on_the_cores_is_noticed(tmp_path):
    """Two processes that share a core: half of it is the other's."""
    command = [sys.executable, "-c", BURN]
    pin = f"import os; os.sched_setaffinity(0, {{{CORE}}})\n{BURN.replace(str(BURNT_S), '60.0')}"
    with subprocess.Popen([sys.executable, "-c", pin]) as other:
        used = measuring.measured(command, (CORE,), tmp_path / "log")
        other.kill()
    assert used.beside > 0.3
    assert used.cpu_s < BURNT_S + STARTED_S


def test_a_command_that_fails_is_told(tmp_path):
    fail = [sys.executable, "-c", "print('no such image'); raise SystemExit(4)"]
    with pytest.raises(measuring.Failed, match=rf"ended with 4 \(no such image\); see {tmp_path}/log"):
        measuring.measured(fail, (CORE,), tmp_path / "log")


def test_a_command_that_takes_too_long_is_ended(tmp_path):
    with pytest.raises(measuring.Failed, match="ended with 124"):
        measuring.measured([sys.executable, "-c", "import time; time.sleep(60)"], (CORE,), tmp_path / "log", limit_s=1)


def test_pairs_are_those_that_meet_at_a_usable_angle(scene):
    """Views look 1, 18 and -17 degrees ahead: the last two meet at 35."""
    assert scene.pairs == [("nadir", "fore"), ("nadir", "aft")]
    both = replace(scene, images={name: scene.images[name] for name in ("fore", "aft")})
    assert both.pairs == [("fore", "aft")] or both.pairs == [("aft", "fore")]


def test_the_terrain_model_is_coarse_and_lies_where_the_scene_does(scene):
    with rasterio.open(scene.terrain) as terrain, rasterio.open(scene.truth) as truth:
        assert terrain.crs.to_epsg() == 4326
        low, high = truth.read(1).min(), truth.read(1).max()
        heights = terrain.read(1)
        assert np.isfinite(heights).all()
        assert low <= heights.min()
        assert heights.max() <= high
        west, south, east, north = rasterio.warp.transform_bounds(truth.crs, terrain.crs, *truth.bounds)
        assert terrain.bounds.left < west
        assert terrain.bounds.right > east
        assert terrain.bounds.bottom < south
        assert terrain.bounds.top > north


def test_cars_gets_all_that_it_needs(scene, tmp_path):
    found = cars.configuration(scene, tmp_path)
    assert found["input"]["pairing"] == [["nadir", "fore"], ["nadir", "aft"]]
    assert {name: Path(of["image"]) for name, of in found["input"]["sensors"].items()} == scene.images
    assert found["input"]["initial_elevation"]["dem"] == str(scene.terrain)
    # Heights above the ellipsoid, in and out.
    with rasterio.open(found["input"]["initial_elevation"]["geoid"]) as geoid:
        assert not geoid.read(1).any()
    assert found["output"] == {
        "geoid": False, "product_level": "dsm", "directory": str(tmp_path / "cars"), "resolution": 0.5, "epsg": 32632,
    }  # fmt: skip
    assert found["subsampling"]["advanced"]["resolutions"] == [2, 1]
    (method,) = found["surface_modeling"]["applications"]["all"]["dense_matching"].values()
    assert method == "pandora_census_sgm_urban"
    (sparse,) = found["tie_points"]["applications"]["all"].values()
    searched = HEIGHTS[1] - HEIGHTS[0]
    assert sparse["disparity_bounds_estimation"] == {"lower_margin": searched, "upper_margin": searched}


def test_a_matcher_of_rows_finds_a_surface(scene, tmp_path):
    """Pairs are rectified, matched (by OpenCV, which is here too) and merged: an analytic surface comes back."""
    here = environments.Environment(Path(sys.prefix))
    dsm, used = matchers.opencv(here).run(scene, tmp_path / "run", (CORE,))
    with rasterio.open(dsm) as found, rasterio.open(scene.truth) as truth:
        assert found.transform == truth.transform
        off = np.abs(found.read(1) - truth.read(1))
    assert (off > PRECISE_M).mean() < FALSE_SHARE
    assert used.cpu_s > 0


S2P = """
import json, pathlib, sys
import numpy as np, rasterio
config = json.loads(pathlib.Path(sys.argv[1]).read_text())
assert config["full_img"] is True and config["dsm_resolution"] == 0.5 and config["out_crs"] == "EPSG:32632"
out = pathlib.Path(config["out_dir"]); out.mkdir()
names = [pathlib.Path(each["img"]).stem for each in config["images"]]
print(*names)
z = np.full((100, 100), 60.0 if "fore" in names[1] else 50.0, np.float32)
with rasterio.open(out / "dsm.tif", "w", driver="GTiff", height=100, width=100, count=1, dtype="float32",
                   nodata=np.nan, crs=config["out_crs"],
                   transform=rasterio.transform.from_origin(461975, 5247025, 0.5, 0.5)) as file:
    file.write(z, 1)
"""


def test_s2p_as_its_documents_say(scene, tmp_path):
    """All images at once where the first makes pairs with all others; its version is that of its environment."""
    bin_ = tmp_path / "environment" / "bin"
    bin_.mkdir(parents=True)
    versions = program(bin_, "import sys; print(*('1.0b26' for _ in sys.argv[3:]), sep='\\n')")
    versions.rename(bin_ / "python")
    s2p = builds.S2p(program(bin_, S2P))
    assert s2p.versions()["s2p"] == "1.0b26"
    assert builds.S2p(tmp_path / "elsewhere" / "s2p").versions()["s2p"] == "unknown"
    dsm, _ = s2p.run(scene, tmp_path / "run", (CORE,))
    assert dsm == tmp_path / "run" / "s2p" / "dsm.tif"
    assert (tmp_path / "run" / "s2p.log").read_text().split() == [path.stem for path in scene.images.values()]


def test_s2p_matches_pairs_where_the_first_image_is_not_in_all(scene, tmp_path):
    """Of views that meet at 35 degrees, those that make pairs with the one between them; cells take the median."""
    of_dates = replace(scene, images={name: scene.images[name] for name in ("fore", "nadir", "aft")})
    assert builds.together_with_first(of_dates) == [("nadir", "fore"), ("nadir", "aft")]
    dsm, _ = builds.S2p(program(tmp_path, S2P)).run(of_dates, tmp_path / "run", (CORE,))
    with rasterio.open(dsm) as file:
        assert (file.read(1) == 55.0).all()


def test_micmac_as_its_documents_say(scene, tmp_path):
    """Its steps in their order, RPC beside the images; its raster of numbers becomes metres with a place."""
    build = program(
        tmp_path,
        """
        import pathlib, sys
        import numpy as np, rasterio
        step = sys.argv[1]
        with open("steps", "a") as steps:
            print(*sys.argv[1:], file=steps)
        if step == "Malt":
            folder = pathlib.Path("MEC-Malt"); folder.mkdir()
            z, mask = np.array([[10, 11], [12, 13]], np.float32), np.array([[1, 1], [0, 1]], np.uint8)
            for name, array in (("Z_Num7_DeZoom2_STD-MALT", 9 * z), ("Z_Num8_DeZoom1_STD-MALT", z),
                                ("AutoMask_STD-MALT_Num_7", mask)):
                with rasterio.open(folder / f"{name}.tif", "w", driver="GTiff", height=2, width=2, count=1,
                                   dtype=array.dtype) as file:
                    file.write(array, 1)
            (folder / "Z_Num8_DeZoom1_STD-MALT.xml").write_text(
                "<FileOriMnt><OriginePlani>462000 5247000</OriginePlani><ResolutionPlani>0.5 -0.5</ResolutionPlani>"
                "<OrigineAlti>400</OrigineAlti><ResolutionAlti>0.5</ResolutionAlti></FileOriMnt>")
        """,
    )
    scene = replace(scene, shifts={"fore": (2.0, -0.5)})
    dsm, _ = builds.MicMac(build).run(scene, tmp_path / "run", (CORE,))
    with rasterio.open(dsm) as file:
        np.testing.assert_array_equal(file.read(1), [[405.0, 405.5], [np.nan, 406.5]])
        assert file.transform == from_origin(462000 - 0.25, 5247000 + 0.25, 0.5, 0.5)
        assert file.crs.to_epsg() == 32632
    steps = (tmp_path / "run" / "work" / "steps").read_text().splitlines()
    assert [step.split()[0] for step in steps] == ["Convert2GenBundle", "Malt"]
    assert "ResolTerrain=0.5" in steps[-1]
    assert "BoxTerrain=[{},{},{},{}]".format(*scene.bounds) in steps[-1]
    assert "+proj=utm +zone=32" in (tmp_path / "run" / "work" / "ground.xml").read_text()
    for view, path in scene.images.items():
        given, (right, down) = read_rpc_txt(tmp_path / "run" / "work" / f"{path.stem}.txt"), scene.shift(view)
        with rasterio.open(path) as file:
            assert (given.samp_off, given.line_off) == (file.rpcs.samp_off + right, file.rpcs.line_off + down)


def test_setsm_as_its_manual_says(scene, tmp_path):
    """Every pair is matched on the area of the scene, and cells get the median of the pairs."""
    build = program(
        tmp_path,
        """
        import pathlib, sys
        import numpy as np, rasterio
        words = sys.argv[1:]
        first, second = (words[k + 1] for k, word in enumerate(words) if word == "-image")
        said = dict(zip(words[4::2], words[5::2]))
        assert all(pathlib.Path(each).with_suffix(".xml").exists() for each in (first, second))
        assert (said["-minH"], said["-outres"], said["-utm_zone"], said["-North"]) == ("25.0", "0.5", "32", "1")
        # Its heights stand at the corners of its cells; those of the first row lie north of the area.
        west, north = float(said["-boundary_min_X"]), float(said["-boundary_max_Y"])
        out = pathlib.Path(said["-outpath"]); out.mkdir()
        z = np.full((101, 100), 50.0 if "fore" in second else 52.0, np.float32); z[:, :10] = -9999
        z[3, 20] = 70.0
        with rasterio.open(out / f"{out.name}_dem.tif", "w", driver="GTiff", height=101, width=100, count=1,
                           dtype="float32", nodata=-9999, crs="EPSG:32632",
                           transform=rasterio.transform.from_origin(west, north, 0.5, 0.5)) as file:
            file.write(z, 1)
        """,
    )
    dsm, _ = builds.Setsm(build).run(scene, tmp_path / "run", (CORE,))
    with rasterio.open(dsm) as file:
        heights = file.read(1)
    assert np.isnan(heights[:, :10]).all()
    assert heights[2, 20] == 70.0
    assert np.unique(heights[:, 10:]).tolist() == [51.0, 70.0]
    for name, path in scene.images.items():
        plain = tmp_path / "run" / f"{name}.tif"
        with rasterio.open(path) as given:
            np.testing.assert_array_equal(builds.pixels(plain), given.read(1))
            assert read_by_lines(plain.with_suffix(".xml"))["LINENUMCOEF"] == given.rpcs.line_num_coeff


def read_by_lines(path: Path) -> dict[str, list[float]]:
    """Numbers of the XML that SETSM is given, read as it does: a tag and its value on each line."""
    lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    corners = lines.index("<BAND_P>") + 1
    assert [line[1:3] for line in lines[corners : corners + 12 : 3]] == ["UL", "UR", "LR", "LL"]
    assert "<IMAGE>" in lines[corners:]
    values = (re.fullmatch(r"<(\w+)>(.+)</\1>", line) for line in lines)
    return {
        match[1]: [float(word) for word in match[2].split()]
        for match in values
        if match and match[1] not in ("SATID", "FIRSTLINETIME")
    }


def test_setsm_is_told_where_the_satellite_was(scene):
    """The angle between the rays of two views, as SETSM computes it of azimuths and elevations; and their pixels."""
    found, rays = isd.metadata(scene), dict(zip(scene.images, scene.rays(), strict=True))
    for a, b in scene.pairs:
        (first, second), turn = (
            np.radians([found[a].elevation_deg, found[b].elevation_deg]),
            np.radians(found[a].azimuth_deg - found[b].azimuth_deg),
        )
        cosine = np.sin(first) * np.sin(second) + np.cos(first) * np.cos(second) * np.cos(turn)
        assert cosine == pytest.approx(rays[a] @ rays[b], abs=1e-9)
    for of_image in found.values():
        assert of_image.gsd_m == pytest.approx(0.5, abs=0.1)


def test_a_program_that_is_not_there_is_named(tmp_path):
    with pytest.raises(environments.Missing, match="no program that can be run"):
        builds.working(tmp_path / "mm3d")


def test_a_python_without_wheels_is_not_taken(monkeypatch):
    monkeypatch.setattr(environments, "SUPPORTED", ((2, 6),))
    with pytest.raises(environments.Missing, match=r"no Python of 2\.6 was found"):
        environments.supported_python()


class Copy:
    """A program that is exact, and counts its runs."""

    name = "CARS"

    def __init__(self, fails: bool = False) -> None:
        self.fails, self.runs = fails, 0

    def versions(self) -> dict[str, str]:
        return {"copy": "1.0"}

    def run(self, scene: Any, out: Path, cores: Any) -> tuple[Path, Any]:
        self.runs += 1
        if self.fails:
            raise measuring.Failed(f"copy ended with 1; see {out}")
        out.mkdir(parents=True, exist_ok=True)
        (out / "dsm.tif").write_bytes(scene.truth.read_bytes())
        return out / "dsm.tif", measuring.Usage(3.0, 2.0, 0.5)


def run_copy(copy: Copy, scene: Any, out: Path) -> dict[str, Any]:
    results = Results(out / "results.json", (CORE,))
    results.describe("programs", copy.name, copy.versions())
    running.surfaces_of(scene, [copy], results, out, (CORE,))
    return json.loads((out / "results.json").read_text())


def test_what_was_measured_is_not_measured_again(scene, tmp_path):
    classes = tmp_path / "classes.tif"
    with rasterio.open(scene.truth) as truth:
        write(classes, np.zeros(truth.shape), truth.bounds.left, truth.bounds.top, 0.5)
    copy, scene = Copy(), replace(scene, classes=classes)
    (row,) = run_copy(copy, scene, tmp_path)["surfaces"]
    assert row["classes"]["all"]["within"] == 1.0
    assert row["classes"]["all"]["nmad"] == 0.0
    assert (row["cpu_s"], row["wall_s"], row["peak_gb"]) == (3.0, 2.0, 0.5)
    run_copy(copy, scene, tmp_path)
    assert copy.runs == 1


def test_a_failure_is_kept_and_tried_again(scene, tmp_path):
    copy = Copy(fails=True)
    (row,) = run_copy(copy, scene, tmp_path)["surfaces"]
    assert row["failed"] == "copy ended with 1; see surfaces/sine-3-views/CARS"
    run_copy(copy, scene, tmp_path)
    assert copy.runs == 2


def results_of(**cpu_s: float) -> dict[str, Any]:
    """Made-up results: programs on one scene of two million cells."""
    figures = {"n": 8, "within": 0.9, "nmad": 0.1, "rmse": 1.0, "le90": 0.5, "completeness": 1.0}
    row = {
        "scene": "town, 2 views",
        "wall_s": 4.0,
        "peak_gb": 1.0,
        "when": "2026-01-02T03:04:05+00:00",
        "commit": "abc",
        "judge": "a judge",
        "beside": 0.0,
    }
    return {
        "machine": {"processor": "P", "cores": [0], "of_cores": 2, "memory_gb": 8, "system": "L", "python": "3"},
        "programs": {name: {} for name in cpu_s},
        "scenes": {"town, 2 views": {"kind": "city", "views": 2, "million_cells": 2.0, "pairs": 1, "truth": True}},
        "surfaces": [row | {"program": name, "cpu_s": cpu, "classes": {"all": figures, "ground": figures}}
                     for name, cpu in cpu_s.items()],
        "differences": [], "kernels": [], "middlebury": [],
    }  # fmt: skip


def test_the_page_says_who_wins():
    found = results_of(zlocus=10.0, CARS=600.0, MicMac=70.0)
    found["surfaces"][2]["classes"]["all"] = found["surfaces"][2]["classes"]["all"] | {"nmad": 0.05, "within": 0.8}
    text = page.page_of(found)
    # CARS has the same share, which is no loss; MicMac has the lower NMAD.
    assert "| town, 2 views | zlocus 0.900, CARS 0.900 |" in text
    assert "| **MicMac 0.050 m**, zlocus 0.100 m | a small difference in all classes |" in text
    assert "| town, 2 views | CARS 60.0, **MicMac 7.0** |" in text
    assert "| zlocus | **5.0** | **2.0** | **1.00** | **1.000** | **0.900** |  | **0.900** |  |  | 0.100 |" in text
    assert "Measured 2026-01-02 on 1 of 2 cores of P, 8 GB, L; commit abc; judged by a judge." in text


def test_other_work_on_the_machine_is_told():
    found = results_of(zlocus=10.0, CARS=600.0)
    found["surfaces"][1]["beside"] = 0.2
    said = "Other processes used up to 20% of the cores while these scenes were measured: town, 2 views."
    assert said in page.page_of(found)


def test_a_class_without_cells_has_no_figures(tmp_path):
    found = results_of(zlocus=10.0, CARS=600.0)
    # As the two judges say it.
    nothing = ({"n": 0, "completeness": None, "within": None, "nmad": None}, {"completeness": 0.0, "within": 0.0})
    for row, of_none in zip(found["surfaces"], nothing, strict=True):
        row["classes"]["building"] = of_none
    (tmp_path / "results.json").write_text(json.dumps(found))
    text = page.write_page(tmp_path / "results.json", tmp_path).read_text()
    assert "| **0.900** |  | **0.900** |  |  | **0.100** |" in text
    assert "0.000" not in text


def test_a_failure_stands_on_the_page():
    found = results_of(zlocus=10.0, CARS=600.0)
    found["surfaces"][1] = {
        "scene": "town, 2 views",
        "program": "CARS",
        "failed": "a | b",
        "when": "2026-01-02",
        "commit": "abc",
    }
    assert "| CARS | failed: a / b |" in page.page_of(found)


def test_the_page_of_the_documents_is_that_of_the_results(tmp_path):
    results = ROOT / "benchmarks" / "peers" / "results.json"
    page.write_page(results, tmp_path)
    assert (tmp_path / "peers.md").read_text(encoding="utf-8") == (ROOT / "docs" / "reference" / "peers.md").read_text(
        encoding="utf-8"
    )
    assert all(
        (ROOT / "docs" / "reference" / name).exists()
        for name in re.findall(r"\]\((\w+\.png)\)", page.page_of(results_of(zlocus=1)))
    )


def test_every_configuration_says_why():
    """And is read by some module of the runner."""
    code = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "benchmarks" / "peers").glob("*.py"))
    for path in sorted((ROOT / "benchmarks" / "peers" / "configurations").iterdir()):
        text = path.read_text(encoding="utf-8")
        assert text.startswith("# ") or '"comment"' in text, path.name
        assert f'"{path.stem}"' in code or f"{path.stem}.yaml" in code, path.name
