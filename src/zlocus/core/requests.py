"""Requests of the commands: inputs, grid, heights, views, and the folder of the result."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from zlocus.core.errors import ConfigError, OutputError
from zlocus.core.request_checks import (
    SCENE_SUFFIXES,
    check_bounds,
    check_choice,
    check_heights,
    check_inputs,
    check_positive,
    check_vertical,
    check_vertical_of,
    check_workers,
    is_scene_file,
)

RUN_FILES = ("run.json", "dsm.tif", "cloud.laz", "point.json", "ranking.json", "orientation.json", "scene.yaml")
# Files of a demo: the first marks its folder; the last holds the accuracy against the truth and ends the demo.
DEMO_BEGUN, DEMO_ACCURACY = "demo.json", "accuracy.json"
# The events of a run as lines of JSON, from its first second on.
EVENTS = "events.jsonl"
# What to do about a folder that holds another result.
OTHER_FOLDER = "Choose another folder, or add --overwrite (in Python: overwrite=True)."
# The record of a finished surface: everything that it depends on, and the checksums of its products.
FINISHED = "finished.json"
VIEWS = ("auto", "all")
METHODS = ("mvll-sgm", "mvll", "gc3-sgm", "gc3")
# How images are chosen for a cell, and the methods that go with it, the usual one first.
METHODS_OF_SELECTION = {
    "default": ("mvll-sgm", "mvll", "gc3-sgm"), "guided": ("mvll-sgm", "mvll"), "paper": ("mvll", "gc3"),
}  # fmt: skip
FILLS = ("none", "interpolate", "dem")
PRODUCTS = ("hillshade", "contours", "dtm", "laz", "copc")
# The hillshade is what everyone looks at first and takes a second per million cells; the others are made on request.
DEFAULT_PRODUCTS = ("hillshade",)
EARTHS = ("curved", "flat")


@dataclass(frozen=True)
class DsmRequest:
    """A surface to be made. `None` means: not given, to be found by the run.

    inputs : two or more images with a camera, or one scene file.
    resolution : cell size, m. crs : grid's CRS. bounds : (xmin, ymin, xmax, ymax) in the grid's CRS, m.
    like : raster whose CRS, transform and shape are taken. area, mask : polygons to work in, and to leave out.
    water : polygons of water surfaces, each of which gets one level; water_level : their attribute that holds it, None
    finds it from the images. level_water : whether possible water is levelled too.
    heights : (zmin, zmax), m, in the vertical datum `vertical`. dem : raster around whose heights is searched;
    dem_vertical : its vertical datum, None takes the one of its CRS.
    reference : name of the reference image; with gc3-sgm only the pixels of this image are matched. selection : key of
    `METHODS_OF_SELECTION`: which images are used for a cell, `default` for all, `guided` for a few that labels choose,
    `paper` for those of Ji et al. (2014).
    vertical : vertical datum of all heights: ellipsoid, egm96 or egm2008 in upper or lower case, or the file of a geoid
    raster.
    workers : tiles worked on at a time, in processes; None: as many as there are cores, memory and work for.
    scheduler : address of a Dask cluster that works on them instead. memory_gb : most memory the tiles may take
    together, GB; None: 60 % of what is free. overwrite : whether another run in `out` is replaced. resume : whether
    finished tiles of the same run, and its finished surface, are taken as they are.
    partial : a surface with few heights or doubtful cameras is accepted. products : maps made of the surface, see
    `PRODUCTS`. report : whether report.html is made.

    Raises
    ------
    ConfigError
        A value out of range, or two that exclude each other.
    InputError
        One image only, an image given twice, or a scene file among images.
    """

    inputs: tuple[Path, ...]
    out: Path
    resolution: float | None = None
    crs: str | None = None
    bounds: tuple[float, float, float, float] | None = None
    like: Path | None = None
    area: Path | None = None
    mask: Path | None = None
    heights: tuple[float, float] | None = None
    dem: Path | None = None
    dem_vertical: str | None = None
    reference: str | None = None
    views: str = "auto"
    method: str = "mvll-sgm"
    selection: str = "default"
    vertical: str = "ellipsoid"
    fill: str = "none"
    water: Path | None = None
    water_level: str | None = None
    level_water: bool = False
    partial: bool = False
    workers: int | None = None
    scheduler: str | None = None
    memory_gb: float | None = None
    overwrite: bool = False
    resume: bool = True
    products: tuple[str, ...] = DEFAULT_PRODUCTS
    report: bool = True

    def __post_init__(self) -> None:
        check_inputs(self.inputs)
        self._check_grid()
        _check_products(self.products)
        check_heights(self.heights)
        if self.heights is not None and self.dem is not None:
            raise ConfigError(f"--heights and --dem {self.dem} exclude each other. Leave one out.")
        if self.dem is not None and self.is_in_image_space:
            raise ConfigError(
                f"--method {self.method} searches one range of heights and cannot follow --dem {self.dem}. Give "
                "--heights, or use mvll-sgm."
            )
        for name, value, choices in (
            ("views", self.views, VIEWS),
            ("method", self.method, METHODS),
            ("selection", self.selection, tuple(METHODS_OF_SELECTION)),
            ("fill", self.fill, FILLS),
        ):
            check_choice(name, value, choices)
        self._check_selection()
        if self.scheduler is not None and self.is_in_image_space:
            raise ConfigError(
                f"--method {self.method} matches whole images in one process. Leave --scheduler out, or use mvll-sgm."
            )
        if self.fill == "dem" and self.dem is None:
            raise ConfigError("--fill dem needs the heights of a terrain model. Add --dem RASTER.")
        if self.water_level is not None and self.water is None:
            raise ConfigError(f"--water-level {self.water_level} is given without --water. Give both, or leave it out.")
        check_vertical("vertical", self.vertical)
        check_vertical_of("dem", self.dem, self.dem_vertical)
        check_workers(self.workers)
        check_positive("--memory", self.memory_gb, "GB")

    @property
    def is_in_image_space(self) -> bool:
        """Whether the pixels of reference images are matched, instead of the cells of the ground."""
        return self.method.startswith("gc3")

    def _check_selection(self) -> None:
        methods = METHODS_OF_SELECTION[self.selection]
        if self.method not in methods:
            other = "--selection paper" if self.method == "gc3" else "--selection default"
            raise ConfigError(
                f"--method {self.method} does not go with --selection {self.selection}, which takes "
                f"{' or '.join(methods)}. Give one of these, or {other}."
            )
        if self.selection != "default" and self.views == "all":
            raise ConfigError(
                f"--selection {self.selection} chooses the images, and --views all contradicts that. Leave it out, or "
                "use --selection default."
            )
        if self.selection == "paper" and self.dem is not None:
            raise ConfigError(
                f"--selection paper searches around the heights of feature points, and --dem {self.dem} contradicts "
                "that. Leave it out, or use --selection default."
            )

    def _check_grid(self) -> None:
        check_positive("--resolution", self.resolution, "m")
        given = {"--resolution": self.resolution, "--crs": self.crs, "--bounds": self.bounds}
        extra = [name for name, value in given.items() if value is not None]
        if self.like is not None and extra:
            raise ConfigError(f"--like {self.like} fixes the whole grid already. Leave out {' and '.join(extra)}.")
        check_bounds(self.bounds)


@dataclass(frozen=True)
class SetupRequest:
    """The part of a request from which views, orientation, heights, grid and match scene follow.

    Every command has some of these fields, with the meaning that they have in `DsmRequest`; the others keep the value
    of "not given".
    """

    inputs: tuple[Path, ...]
    crs: str | None = None
    resolution: float | None = None
    bounds: tuple[float, float, float, float] | None = None
    like: Path | None = None
    area: Path | None = None
    mask: Path | None = None
    water: Path | None = None
    heights: tuple[float, float] | None = None
    dem: Path | None = None
    dem_vertical: str | None = None
    vertical: str = "ellipsoid"
    reference: str | None = None
    references: tuple[str, ...] = ()
    workers: int | None = None
    method: str = "mvll-sgm"

    @classmethod
    def of(cls, request: object) -> SetupRequest:
        """The fields that a command's request has, and "not given" for the others."""
        names = [field.name for field in fields(cls)]
        return cls(**{name: getattr(request, name) for name in names if hasattr(request, name)})


@dataclass(frozen=True)
class CloudRequest:
    """A point cloud to be made. `None` means: not given, to be found by the run.

    inputs, crs, bounds, area, heights, vertical, partial, workers, memory_gb, overwrite, resume : as in `DsmRequest`;
    the cloud of an area has the points whose place on the ground lies in it. references : names of the views whose
    pixels get heights; none named means all. fill : of the height maps; the cloud has no filled heights. copc : whether
    the cloud is written as COPC, too.

    Raises
    ------
    ConfigError
        A value out of range.
    InputError
        One image only, an image given twice, or a scene file among images.
    """

    inputs: tuple[Path, ...]
    out: Path
    references: tuple[str, ...] = ()
    crs: str | None = None
    heights: tuple[float, float] | None = None
    fill: str = "none"
    partial: bool = False
    workers: int = 1
    overwrite: bool = False
    vertical: str = "ellipsoid"
    bounds: tuple[float, float, float, float] | None = None
    area: Path | None = None
    memory_gb: float | None = None
    resume: bool = True
    copc: bool = False

    def __post_init__(self) -> None:
        check_inputs(self.inputs)
        check_bounds(self.bounds)
        check_heights(self.heights)
        check_choice("fill", self.fill, FILLS[:2])
        check_vertical("vertical", self.vertical)
        check_workers(self.workers)
        check_positive("--memory", self.memory_gb, "GB")
        for name in self.references:
            if self.references.count(name) > 1:
                raise ConfigError(f"--reference {name} is given twice. Name each view once.")


@dataclass(frozen=True)
class CurvesRequest:
    """The match curves of one point, to be shown. `None` means: not given, to be found by the run.

    inputs, resolution, crs, heights, reference, overwrite : as in `DsmRequest`. at : ground point (x, y), m; pixel :
    view, row and column of an image point; one of both. height : of the point, m, about which curves are sampled.

    Raises
    ------
    ConfigError
        A value out of range, no point, or two.
    InputError
        One image only, an image given twice, or a scene file among images.
    """

    inputs: tuple[Path, ...]
    out: Path
    at: tuple[float, float] | None = None
    pixel: tuple[str, float, float] | None = None
    height: float | None = None
    resolution: float | None = None
    crs: str | None = None
    heights: tuple[float, float] | None = None
    reference: str | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_inputs(self.inputs)
        check_positive("--resolution", self.resolution, "m")
        check_heights(self.heights)
        if (self.at is None) == (self.pixel is None):
            given = "both are given" if self.at is not None else "none is given"
            raise ConfigError(f"The point is asked for by --at X Y or by --pixel VIEW ROW COL, and {given}. Give one.")
        for name, values in (("at", self.at), ("pixel", self.pixel and self.pixel[1:]), ("height", (self.height,))):
            numbers = [v for v in values or () if v is not None]
            if not all(map(math.isfinite, numbers)):
                raise ConfigError(f"--{name} {' '.join(f'{v:g}' for v in numbers)} is no place. Give finite numbers.")


@dataclass(frozen=True)
class RankRequest:
    """Images to be ranked. `None` means: not given, to be found.

    inputs, out, resolution, crs, heights, workers, overwrite : as in `DsmRequest`.

    Raises
    ------
    ConfigError
        A value out of range.
    InputError
        One image only, an image given twice, or a scene file among images.
    """

    inputs: tuple[Path, ...]
    out: Path
    resolution: float | None = None
    crs: str | None = None
    heights: tuple[float, float] | None = None
    workers: int = 1
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_inputs(self.inputs)
        check_positive("--resolution", self.resolution, "m")
        check_heights(self.heights)
        check_workers(self.workers)


@dataclass(frozen=True)
class DoctorRequest:
    """A run to be looked at before it is made. `None` means: not given, to be found, and of `out`: nothing is written.

    inputs, resolution, crs, heights, bounds, workers, memory_gb : as in `DsmRequest`.

    Raises
    ------
    ConfigError
        A value out of range.
    InputError
        One image only, an image given twice, or a scene file among images.
    """

    inputs: tuple[Path, ...]
    out: Path | None = None
    resolution: float | None = None
    crs: str | None = None
    heights: tuple[float, float] | None = None
    workers: int = 1
    memory_gb: float | None = None
    bounds: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        check_inputs(self.inputs)
        check_positive("--resolution", self.resolution, "m")
        check_heights(self.heights)
        check_bounds(self.bounds)
        check_workers(self.workers)
        check_positive("--memory", self.memory_gb, "GB")


@dataclass(frozen=True)
class ImportRequest:
    """Cameras of another program, to become a scene file. `None` means: not given.

    kind : format; source : its folder or file. images : folder of the images. crs : of the result. local : in the local
    frame of the source, at no place of the Earth. up : direction, in the axes of the source, that becomes z of a local
    frame; north : another, that becomes y. offset : m, what was subtracted from coordinates of `crs` to make those of
    the source. focal : px; camera : file with the interior orientation. earth : how a map is understood.

    Raises
    ------
    ConfigError
        A value out of range, or two that exclude each other.
    """

    kind: str
    source: Path
    out: Path
    images: Path | None = None
    crs: str | None = None
    local: bool = False
    up: tuple[float, float, float] | None = None
    north: tuple[float, float, float] | None = None
    offset: tuple[float, float, float] | None = None
    focal: float | None = None
    camera: Path | None = None
    earth: str | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        if not is_scene_file(self.out):
            raise ConfigError(f"-o {self.out} is no name of a scene file. Let it end in {' or '.join(SCENE_SUFFIXES)}.")
        check_positive("--focal", self.focal, "px")
        if self.earth is not None:
            check_choice("earth", self.earth, EARTHS)
        for name, axis in (("up", self.up), ("north", self.north)):
            if axis is not None and not (all(map(math.isfinite, axis)) and any(axis)):
                raise ConfigError(
                    f"--{name} {' '.join(f'{v:g}' for v in axis)} is no direction. Give three numbers, not all 0."
                )
        if self.north is not None and self.up is None:
            raise ConfigError("--north turns the frame about what is up. Give --up too, or leave it out.")
        if self.offset is not None and not all(map(math.isfinite, self.offset)):
            raise ConfigError(f"--offset {' '.join(f'{v:g}' for v in self.offset)} is no place. Give finite numbers.")
        if self.offset is not None and self.crs is None:
            raise ConfigError("--offset leads to coordinates of a map, and there is none. Give --crs, or leave it out.")
        for one, other in (("crs", "local"), ("crs", "up"), ("focal", "camera")):
            if {one, other} <= set(self.given()):
                raise ConfigError(f"--{one} and --{other} exclude each other. Leave one out.")
        if self.earth is not None and self.crs is None:
            raise ConfigError("--earth says how a map is understood, and there is none. Give --crs, or leave it out.")

    def given(self) -> list[str]:
        """Names of the options that only some formats know, where they are given."""
        names = ("crs", "local", "up", "north", "offset", "focal", "camera", "earth")
        values = {name: getattr(self, name) for name in names}
        return [name for name, value in values.items() if value not in (None, False)]


def product_names(text: str) -> tuple[str, ...]:
    """The names of --products, in the order of `PRODUCTS`; `none` is none.

    Raises
    ------
    ConfigError
        A name that is not known.
    """
    names = [] if text.strip() == "none" else [name.strip() for name in text.split(",")]
    _check_products(names)
    return tuple(name for name in PRODUCTS if name in names)


def added_products(text: str) -> tuple[str, ...]:
    """The maps of a surface: the default ones and the names of --products; none at all where that is `none`.

    Raises
    ------
    ConfigError
        A name that is not known.
    """
    names = product_names(text)
    return names and tuple(name for name in PRODUCTS if name in {*DEFAULT_PRODUCTS, *names})


def _check_products(names: Iterable[str]) -> None:
    for name in names:
        if name not in PRODUCTS:
            raise ConfigError(
                f"--products {name} is not known; choose from {', '.join(PRODUCTS)} with commas between them, or none."
            )


def held_files(out: Path, files: Sequence[str] = RUN_FILES) -> list[str]:
    """Names of the given files, by default those of runs, that exist in a folder."""
    return [name for name in files if (out / name).exists()]


def check_output(
    out: Path, overwrite: bool, files: Sequence[str] = RUN_FILES, what: str = "run", may_be_same: bool = False
) -> None:
    """Check, before any work, that a command may write to the folder `out`. Changes nothing on disk.

    files : names of files by which another result is recognised; what : kind of that result, for messages; may_be_same
    : whether an interrupted or finished run in the folder is compared with this one later, see
    `zlocus.pipeline.finished_run.finished_run`.

    Raises
    ------
    OutputError
        `out` is a file, cannot be written, or holds another result and `overwrite` is False.
    """
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out} is a file, and the output must be a folder. Choose another name with -o.")
    held = held_files(out, files)
    is_compared = may_be_same and ((out / "tiles" / "manifest.json").exists() or (out / FINISHED).exists())
    if held and not overwrite and not is_compared:
        raise OutputError(f"{out} holds another {what} ({', '.join(held)}). {OTHER_FOLDER}")
    parent = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    try:
        # Only an attempt tells for sure: permission bits say nothing of read-only disks.
        with tempfile.TemporaryDirectory(prefix=".zlocus-", dir=parent):
            pass
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise OutputError(f"{out} cannot be written: {parent} says {reason}. Choose another folder with -o.") from error


# Beside a run, which has no file of these names, there is room for them.
EVALUATION_FILES = ("evaluation.json", "error.tif", "histogram.png")
# Of points: in place of the map, each point with its error.
POINT_EVALUATION_FILES = ("evaluation.json", "points.csv", "histogram.png")
COMPARISON_FILES = ("compare.html", "difference.tif")
