"""What holds for every module of the package and every file of tests, checked on the source."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from annotated_names import annotated_names, class_definitions, wrongly_named
from places import ROOT, TESTS

SOURCE = ROOT / "src" / "zlocus"
MODULES = sorted(SOURCE.rglob("*.py"))
MAX_MODULE_LINES = 500
MAX_FUNCTION_LINES = 60
NETWORK = {
    "socket", "urllib", "http", "requests", "ftplib", "smtplib", "aiohttp", "httpx", "starlette", "uvicorn",
}  # fmt: skip
# Packages that only compute: they open no file, read no environment, and import neither Dask nor rasterio nor GDAL.
NO_FILES = ("matching", "orientation", "sensors")
# The decorator of the kernels finds the folder of compiled code, which depends on the content of the sources.
DECORATOR = "core/jit.py"
MAX_ROOT_ENTRIES = 16
FILE_CALLS = {
    "open",
    "read_text",
    "read_bytes",
    "write_text",
    "write_bytes",
    "memmap",
    "load",
    "save",
    "fromfile",
    "tofile",
}


def name_of(module: Path) -> str:
    return str(module.relative_to(SOURCE))


every_module = pytest.mark.parametrize("module", MODULES, ids=name_of)


@cache
def tree_of(module: Path) -> ast.Module:
    return ast.parse(module.read_text(encoding="utf-8"))


def functions(module: Path) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [n for n in ast.walk(tree_of(module)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]


def public(body: list[ast.stmt], prefix: str = ""):
    """Public classes, functions and methods with their names."""
    for node in body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public(node.body, f"{prefix}{node.name}.")


def called(module: Path) -> set[str]:
    """Names of everything a module calls: `f` of f() and of x.f()."""
    calls = (n.func for n in ast.walk(tree_of(module)) if isinstance(n, ast.Call))
    return {f.attr if isinstance(f, ast.Attribute) else f.id for f in calls if isinstance(f, ast.Attribute | ast.Name)}


def imported(module: Path) -> set[str]:
    """Top-level names of everything a module imports."""
    found = set()
    for node in ast.walk(tree_of(module)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.split(".")[0])
    return found


def test_the_source_is_there():
    assert len(MODULES) > 20
    assert all((SOURCE / name).is_dir() for name in NO_FILES)
    assert (SOURCE / DECORATOR).is_file()


def test_the_root_of_the_package_stays_small():
    entries = sorted(p.name for p in SOURCE.iterdir() if p.name != "__pycache__")
    assert len(entries) <= MAX_ROOT_ENTRIES, entries


@every_module
def test_modules_stay_short(module):
    assert len(module.read_text(encoding="utf-8").splitlines()) < MAX_MODULE_LINES


@every_module
def test_functions_stay_short(module):
    long = {f.name: f.end_lineno - f.lineno + 1 for f in functions(module)}
    assert {name: lines for name, lines in long.items() if lines > MAX_FUNCTION_LINES} == {}


@every_module
def test_public_names_have_a_docstring(module):
    tree = tree_of(module)
    missing = [name for name, node in public(tree.body) if not ast.get_docstring(node)]
    assert missing == []
    assert ast.get_docstring(tree) or not tree.body


# The inspector's modules answer requests from this machine; each may import these.
LISTENS = {
    "inspector/serving.py": {"socket", "uvicorn"},
    "inspector/server.py": {"starlette"},
    "inspector/guard.py": {"starlette"},
}


@every_module
def test_no_module_reaches_for_the_network(module):
    listens = LISTENS.get(module.relative_to(SOURCE).as_posix(), set())
    assert imported(module) & NETWORK == listens
    addresses = re.findall(r"https?://[^\s\"'>)]+", module.read_text(encoding="utf-8"))
    # The address of the inspector's own page is put together from host and port; that of SVG is the format's name.
    own = r"http://\{\w+" if listens else "http://www.w3.org/2000/svg$"
    if module.relative_to(SOURCE).as_posix() == "io/iso_xml.py":  # which is about the names of that format
        own = r"https?://(standards\.iso\.org|schemas\.isotc211\.org|www\.opengis\.net|www\.w3\.org)/"
    if module.relative_to(SOURCE).as_posix() == "products/stac_item.py":  # the names of STAC's extensions
        own = r"https://stac-extensions\.github\.io/\{name\}/schema\.json$"
    if module.relative_to(SOURCE).as_posix() == "io/styles/sld.py":
        own = r"http://www\.opengis\.net/(sld|ogc)$"
    assert [each for each in addresses if not re.match(own, each)] == []


COMPUTING = [m for m in MODULES if m.relative_to(SOURCE).parts[0] in NO_FILES]


@pytest.mark.parametrize("module", COMPUTING, ids=name_of)
def test_packages_that_compute_open_no_file(module):
    assert called(module) & FILE_CALLS == set()
    assert imported(module) & {"os", "io", "rasterio", "osgeo", "dask", "pyogrio", "tempfile"} == set()


@every_module
def test_kernels_are_compiled_by_our_decorator_only(module):
    if name_of(module) != DECORATOR:
        assert not re.search(r"@(numba\.)?(n?jit|vectorize|guvectorize)\b", module.read_text(encoding="utf-8"))


# The noun of each class that is not called by its own name in snake case, or by the same last words of it everywhere.
NOUNS: dict[str, tuple[str, ...]] = {
    # The nouns of the style guide, section 2 and the words that every module shares.
    "CellWindow": ("window",),
    "ImageMask": ("mask",),
    "MaskEntry": ("entry", "mask"),
    "MatchScene": ("match_scene",),
    "Observations": ("observations",),
    "Orientation": ("orientation",),
    "Quality": ("quality", "flag"),
    "RunConfig": ("config",),
    "Scene": ("scene",),
    "Stopwatch": ("stopwatch",),
    "Surface": ("surface",),
    "Tile": ("tile",),
    "TileJob": ("tile_job",),
    "TileViews": ("tile_views", "slope_views"),
    "VerticalDatum": ("vertical_datum",),
    "View": ("view",),
    "ZlocusError": ("error",),
    # The classes of one protocol have its noun.
    "CameraEntry": ("camera", "entry"),
    "ColourEntry": ("colours",),
    "DeliveredImage": ("image",),
    "DeliveredView": ("view",),
    "DepthRays": ("rays",),
    "FrameCamera": ("camera",),
    "FrameModel": ("sensor",),
    "HeightRays": ("rays",),
    "ImageSource": ("image",),
    "LineProgress": ("progress",),
    "NotebookProgress": ("progress",),
    "LineScanCamera": ("camera",),
    "LocationGridCamera": ("camera",),
    "LineScanModel": ("sensor",),
    "LineScanner": ("camera",),
    "OpenedCamera": ("camera",),
    "PlacedTile": ("tile",),
    "RasterImage": ("image",),
    "ResolvedEntry": ("entry",),
    "RectifiedScanner": ("camera",),
    "SensorModel": ("sensor",),
    # The noun is in the middle of the class's name, or the class is one of several kinds of it.
    "BrownEntry": ("distortion",),
    "EarthSpace": ("earth",),
    "ExportArea": ("area",),
    "ExportedPoints": ("points", "exported_points"),
    "ExportedView": ("exported", "exported_view"),
    "FeaturePoints": ("features", "feature_points"),
    "FisheyeEntry": ("distortion",),
    "FittedPlanes": ("fitted", "fitted_planes"),
    "GeoidRaster": ("geoid",),
    "GreyScale": ("scale", "grey_scale"),
    "GridTies": ("ties",),
    "HeightFile": ("height_file", "reference"),
    "HeightRaster": ("surface", "reference", "raster"),
    "HeldPixels": ("held", "pixels"),
    "LocalFrame": ("frame",),
    "MeshTile": ("tile",),
    "SurfaceWindow": ("window",),
    "TextureImage": ("image",),
    "ImageQuality": ("quality",),
    "ImportedExposure": ("exposure",),
    "InputFiles": ("inputs",),
    "HorizontalAccuracy": ("accuracy", "horizontal"),
    "KnownPoints": ("points", "parts"),
    "LineTimes": ("times", "lines"),
    "MatchedImage": ("image", "matched_image"),
    "MatchedPixels": ("matched", "pixels"),
    "PairGeometry": ("pair",),
    "PairMatches": ("pair", "matches"),
    "PointReference": ("reference",),
    "Polygons": ("polygons", "area"),
    "ProfileSampling": ("sampling",),
    "QuickTies": ("ties",),
    "RollingShutterEntry": ("rolling_shutter",),
    "RefinedTies": ("ties",),
    "RefusedProduct": ("refused", "refused_products"),
    "RefusedView": ("refused",),
    "RegularTimes": ("times",),
    "RpcCoefficients": ("rpc",),
    "RunPlan": ("plan",),
    "PaperSpace": ("space",),
    "SearchGeometry": ("geometry",),
    "SelectionArea": ("area",),
    "TerrainHeights": ("terrain",),
    "TileInputs": ("tile",),
    "TrajectoryNoise": ("noise",),
    "TruthBlocks": ("truth",),
    "VerticalAccuracy": ("accuracy", "nva", "vva"),
    "ViewArrays": ("views", "arrays"),
    "ViewEntry": ("entry", "view"),
    "ViewGeometry": ("view", "geometry"),
    "BandWindow": ("window",),
    "GroundMatches": ("matches",),
    "GroundReference": ("reference",),
    "MosaicPlan": ("plan",),
    "NoGroundMatch": ("missing",),
    "OrthoReference": ("reference",),
    "PointedView": ("pointed",),
    "SurfaceHeights": ("surface",),
    # Users read these as fields of an orientation: `orientation.views[i].shift_px`, `orientation.pairs`.
    "PairOrientation": ("pair",),
    "ViewOrientation": ("view",),
    # The name says the role, because a record holds several of one class.
    "AxisGrid": ("axis_grid", "x", "y"),
    "BlockGrid": ("block_grid", "low", "middle", "high"),
    "ChosenViews": ("chosen_views", "chosen"),
    "ComparedSurface": ("surface", "first", "second"),
    "MeasuredDistances": ("distances", "wide", "narrow"),
    "ChangeNoise": ("noise",),
    "PairOffset": ("pair",),
    "FitSample": ("sample",),
    "OrthoSource": ("source",),
    "PairSample": ("sample",),
    "PlacedSurface": ("placed",),
    "PolygonFeatures": ("features",),
    "StableWindow": ("window",),
    "SurfaceInput": ("surface", "source", "first", "other", "one"),
    "ValueColour": ("colour", "classes", "stops"),
    "VisibleHeights": ("visible", "visible_heights", "matched", "helpful"),
    # Options are `options`, or have the name of their stage, here in the plural or as one word.
    "CheckOptions": ("checks", "options"),
    "PlaneOptions": ("planes", "options"),
    "ProductOptions": ("products", "options"),
    "SemiGlobalOptions": ("semiglobal", "options"),
}
# Class names that stand in two modules still, and the reason. Nothing may be added.
CLASS_NAMES_TWICE: dict[str, str] = {}
# Names of a class that are not its noun still, and the reason: (class, name). Nothing may be added.
SECOND_NAMES: dict[tuple[str, str], str] = {
    ("CoarserHeights", "coarser"): "says its part in matching/true_ortho.py",
    ("CoarsestHeights", "coarsest"): "says its part in matching/overlap.py",
    ("ColourSource", "coloured"): "says its part in matching/true_ortho.py",
    ("Finding", "entries"): "says its part in pipeline/doctor/run.py",
    ("MatchedPixels", "checked"): "says its part in pipeline/image_tiles.py",
    ("MatchedPixels", "unchecked"): "says its part in pipeline/image_tiles.py",
    ("PixelHeights", "all_matched"): "says its part in pipeline/image_tiles.py",
    ("PixelHeights", "images"): "says its part in pipeline/image_tiles.py",
    ("PlanarHeights", "known"): "says its part in matching/plane_fitting.py",
    ("Quality", "reason"): "says its part in matching/height_checks.py, pipeline/image_tiles.py",
    ("RefinedHeights", "refined"): "says its part in matching/height_checks.py, matching/precision.py",
    ("Restored", "_scene"): "says its part in inspector/inspection.py",
    ("Scene", "corrected"): "says its part in pipeline/doctor/run.py",
    ("ExpectedBounds", "expected"): "says its part in matching/overlap.py",
    ("VerticalDatum", "vertical"): "says its part in products/rasters.py",
    ("ViewSpec", "view"): "says its part in synthetic/linescan.py, synthetic/scenes.py",
    ("ViewSpec", "views"): "says its part in synthetic/scenes.py",
    ("VisibleHeights", "shown"): "says its part in matching/overlap.py",
    ("ZlocusError", "failed"): "says its part in pipeline/surface_products.py",
}


def test_a_class_name_occurs_once():
    twice = {name: places for name, places in class_definitions(SOURCE).items() if len(places) > 1}
    assert {name: places for name, places in twice.items() if name not in CLASS_NAMES_TWICE} == {}
    assert set(CLASS_NAMES_TWICE) <= set(twice), "these occur once by now: take them off the list"


def test_a_noun_has_one_variable_name():
    wrong = wrongly_named(SOURCE, NOUNS)
    assert [each for each in wrong if (each.class_name, each.name) not in SECOND_NAMES] == []
    assert set(SECOND_NAMES) <= {(e.class_name, e.name) for e in wrong}, "these are mended: take them off the list"
    assert set(NOUNS) <= set(class_definitions(SOURCE)), "these classes are gone: take them off the list"


PLANTED = """
class Scene: ...
class MatchScene: ...
class DsmRequest: ...
class View:
    def same_as(self, other: "View") -> bool: ...

class Settled:
    scene: Scene
    oriented_scene: Scene | None
    views: tuple[View, ...]
    view_of_name: dict[str, View]

def run(request: DsmRequest, match_scene: MatchScene, view_a: View) -> None: ...
def again(order: DsmRequest, request: DsmRequest, scene: "MatchScene", settled: Scene, others: list[View]) -> None: ...
"""


def test_a_planted_second_name_is_seen(tmp_path):
    (tmp_path / "planted.py").write_text(PLANTED)
    (tmp_path / "more.py").write_text("class View: ...")
    wrong = wrongly_named(tmp_path, {"MatchScene": ("match_scene",)})
    found = {(each.class_name, each.name) for each in wrong}
    assert found == {("DsmRequest", "order"), ("MatchScene", "scene"), ("Scene", "settled"), ("View", "others")}
    assert len(annotated_names(tmp_path)) == 12
    assert len(class_definitions(tmp_path)["View"]) == 2


# Tests of whole runs, of the documentation, of the benchmarks and of what is installed belong to no single module.
NOT_MIRRORED = ("runs", "docs", "benchmarks", "installation")
# Tests of the whole package, or of several of its modules.
OF_SEVERAL_MODULES = {"test_architecture.py", "test_kernel_signatures.py", "matching/test_stages_against_twins.py"}


def files_without_a_module(tests: Path, source: Path) -> list[str]:
    """Files of tests that are not named after a module or package at the same place in the source.

    The file begins with the name of its module: test_view_ranking_order.py holds tests of view_ranking.py.
    """
    lost = []
    for file in sorted(tests.rglob("test_*.py")):
        folder = file.relative_to(tests).parent
        if folder.parts[:1] and folder.parts[0] in NOT_MIRRORED:
            continue
        mirrored = source / folder
        names = {p.stem for p in mirrored.iterdir() if p.name != "__pycache__"} if mirrored.is_dir() else set()
        names.add(mirrored.name)
        if not any(f"{file.stem}_".startswith(f"test_{name}_") for name in names):
            lost.append(file.relative_to(tests).as_posix())
    return lost


def test_files_of_tests_mirror_the_source():
    lost = files_without_a_module(TESTS, SOURCE)
    assert [name for name in lost if name not in OF_SEVERAL_MODULES] == []


def test_a_planted_test_without_a_module_is_seen(tmp_path):
    for path in ("source/io/images.py", "tests/io/test_images.py", "tests/io/test_images_remote.py",
                 "tests/io/test_io_damage.py", "tests/io/test_imagery.py", "tests/runs/test_town.py",
                 "tests/gone/test_images.py"):  # fmt: skip
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    assert files_without_a_module(tmp_path / "tests", tmp_path / "source") == [
        "gone/test_images.py",
        "io/test_imagery.py",
    ]
