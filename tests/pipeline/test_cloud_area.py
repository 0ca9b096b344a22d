"""`zlocus cloud --bounds --area --memory`: an area has the points of the whole cloud, and bad areas are refused."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
import shapely
from typer.testing import CliRunner

from rendered_scenes import CENTRE, HEIGHTS, LOOKS
from zlocus.cli.app import app
from zlocus.core.errors import ConfigError, GeometryError, InputError
from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.core.progress import LineProgress
from zlocus.core.requests import CloudRequest
from zlocus.io.open_raster import open_raster
from zlocus.matching.quality import Quality
from zlocus.pipeline.cloud import run_cloud
from zlocus.products.point_cloud import PLY_POINT

# Four tiles of each image.
FOUR_TILES = RunConfig(pyramid=PyramidOptions(tile=64))
N_TILES = 12
# An area in the western half of the images, and a triangle around its middle.
WEST = (CENTRE[0] - 32.0, CENTRE[1] - 12.0, CENTRE[0] - 14.0, CENTRE[1] + 9.0)
TRIANGLE = [
    (CENTRE[0] - 34.0, CENTRE[1] - 8.0),
    (CENTRE[0] - 14.0, CENTRE[1] - 9.0),
    (CENTRE[0] - 20.0, CENTRE[1] + 13.0),
]


def in_west(points: np.ndarray) -> np.ndarray:
    """Which points lie in the area."""
    x, y = points["xyz"][:, 0], points["xyz"][:, 1]
    return (x >= WEST[0]) & (x < WEST[2]) & (y >= WEST[1]) & (y < WEST[3])


def made(images, out, **asked):
    """A cloud in small tiles, and what was said."""
    said = io.StringIO()
    request = CloudRequest(
        images("sine").inputs, out, **{"crs": "EPSG:32632", "heights": HEIGHTS, "partial": True} | asked
    )
    return run_cloud(request, FOUR_TILES, LineProgress(said)), said.getvalue()


def points_of(out: Path) -> np.ndarray:
    """Points of cloud.ply, sorted by their places."""
    points = np.frombuffer((out / "cloud.ply").read_bytes().split(b"end_header\n", 1)[1], PLY_POINT)
    return points[np.lexsort(points["xyz"].T)]


def read(path: Path) -> np.ndarray:
    with open_raster(path) as source:
        return source.read(1)


def write_polygon(path: Path, ring, crs="EPSG::32632") -> Path:
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}}
    named = {"type": "name", "properties": {"name": f"urn:ogc:def:crs:{crs}"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": named, "features": [feature]}))
    return path


@pytest.fixture(scope="module")
def whole(images, tmp_path_factory):
    return made(images, tmp_path_factory.mktemp("whole") / "out")


def n_tiles(said: str) -> int:
    return int(
        re.findall(r"^Plan: (\d+) tiles of 3 images, 1 at a time in this process, about ", said, re.MULTILINE)[0]
    )


def test_the_points_of_bounds_are_those_of_the_whole_cloud(images, whole, tmp_path):
    result, said = made(images, tmp_path / "part", bounds=WEST)
    every = points_of(whole[0].out)
    inside = in_west(every)
    assert 0.03 < inside.mean() < 0.3
    np.testing.assert_array_equal(points_of(result.out), every[inside])
    assert result.n_points == inside.sum()
    assert n_tiles(said) < n_tiles(whole[1]) == N_TILES


def test_maps_say_what_lies_outside(images, whole, tmp_path):
    result, _ = made(images, tmp_path / "part", bounds=WEST)
    for name in LOOKS:
        height, quality = (read(result.out / f"{name}_{what}.tif") for what in ("height", "quality"))
        of_whole = read(whole[0].out / f"{name}_height.tif")
        known = np.isfinite(height)
        np.testing.assert_array_equal(height[known], of_whole[known])
        is_outside = (quality & np.uint16(Quality.OUTSIDE)) != 0
        assert not (is_outside & known).any()
        lost = np.isfinite(of_whole) & ~known
        assert is_outside[lost].all()
        # Pixels without a height count as inside or outside too, so the share of heights is that of the area.
        assert (~is_outside & ~known).sum() < 0.3 * known.sum()
    assert result.coverage == pytest.approx(whole[0].coverage, abs=0.05)


def test_the_points_of_polygons_are_those_of_the_whole_cloud(images, whole, tmp_path):
    area = write_polygon(tmp_path / "area.geojson", TRIANGLE)
    every, triangle = points_of(whole[0].out), shapely.Polygon(TRIANGLE)
    inside = shapely.contains_xy(triangle, every["xyz"][:, 0], every["xyz"][:, 1])
    result, said = made(images, tmp_path / "part", area=area)
    np.testing.assert_array_equal(points_of(result.out), every[inside])
    assert n_tiles(said) < N_TILES
    both, _ = made(images, tmp_path / "both", area=area, bounds=WEST)
    inside &= in_west(every)
    np.testing.assert_array_equal(points_of(both.out), every[inside])
    record = json.loads((both.out / "run.json").read_text())
    assert [Path(entry["path"]).name for entry in record["inputs"]][-1] == "area.geojson"


def test_areas_side_by_side_share_no_point(images, whole, tmp_path):
    middle = round((WEST[0] + WEST[2]) / 2)
    west, _ = made(images, tmp_path / "west", bounds=(WEST[0], WEST[1], middle, WEST[3]))
    east, _ = made(images, tmp_path / "east", bounds=(middle, WEST[1], WEST[2], WEST[3]))
    both, _ = made(images, tmp_path / "both", bounds=WEST)
    assert west.n_points + east.n_points == both.n_points


def test_an_area_that_nobody_sees_is_refused(images, tmp_path):
    out, away = tmp_path / "out", (CENTRE[0] + 5000.0, CENTRE[1], CENTRE[0] + 5100.0, CENTRE[1] + 50.0)
    says = r"asked for \(E 467000 to 467100 m, N 5247000 to 5247050 m\) lies outside the ground that two images see"
    with pytest.raises(GeometryError, match=says):
        made(images, out, bounds=away)
    ring = [(away[0], away[1]), (away[2], away[1]), (away[2], away[3])]
    with pytest.raises(GeometryError, match=r"inside .*away\.geojson\. Check the polygons and their CRS"):
        made(images, out, area=write_polygon(tmp_path / "away.geojson", ring))
    (tmp_path / "text.geojson").write_text("none")
    with pytest.raises(InputError, match=r"text\.geojson cannot be read as vector file"):
        made(images, out, area=tmp_path / "text.geojson")
    with pytest.raises(InputError, match=r"missing\.gpkg"):
        made(images, out, area=tmp_path / "missing.gpkg")
    assert not out.exists()


def test_too_little_memory_is_refused_before_the_first_tile(images, tmp_path):
    with pytest.raises(ConfigError, match=r"--memory 0\.1 GB is too little for one tile, which needs about"):
        made(images, tmp_path / "out", memory_gb=0.1)
    assert not (tmp_path / "out").exists()


def test_the_plan_is_said_before_the_first_tile(images, tmp_path):
    said = made(images, tmp_path / "out", bounds=WEST, memory_gb=4.0)[1]
    assert re.search(r"^Plan: .* about [\d.]+ GB of memory \(of 4 GB\) and [\d.]+ s", said, re.MULTILINE)
    assert said.index("Plan: ") < said.index("Matching: done")


@pytest.mark.parametrize("option", ["--bounds", "--area", "--memory", "--resume"])
def test_options_have_the_words_of_a_surface(option):
    """The help of an option that both commands have is the same."""

    def help_of(command: str) -> str:
        text = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200", "TERM": "dumb"}).stdout
        (line,) = [line for line in text.splitlines() if re.search(rf"{option}\b", line)]
        return " ".join(line.split())

    assert help_of("cloud") == help_of("dsm")
