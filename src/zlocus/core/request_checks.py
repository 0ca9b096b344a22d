"""Checks of the values that requests of several commands share: each refuses a value in one sentence."""

from __future__ import annotations

import glob
import math
from pathlib import Path

from zlocus.core.errors import ConfigError, InputError

# Suffixes of the images that are looked for in a folder.
IMAGE_SUFFIXES = (".tif", ".tiff", ".ntf", ".jp2", ".jpg", ".jpeg", ".png", ".img", ".vrt")
# Suffixes of files that are given by mistake, because they lie beside images.
TEXT_SUFFIXES = (".md", ".pdf", ".txt", ".htm", ".html", ".doc", ".docx", ".csv")
# Ends of the names of files that hold or name several images, and of GDAL's names for what is in an archive.
CONTAINERS = (".zip", ".tar", ".tgz", ".tar.gz", ".json", ".geojson")
ARCHIVE_SYSTEMS = ("/vsizip/", "/vsitar/")
SCENE_SUFFIXES = (".yaml", ".yml")
# Names of vertical datums; the file of a geoid raster may be given instead.
VERTICALS = ("ellipsoid", "egm96", "egm2008")


def check_inputs(inputs: tuple[Path, ...], may_be_single: bool = False) -> None:
    """Refuse inputs that are neither two images or more, each once, nor one scene file, nor deliveries.

    may_be_single : one image is enough.
    """
    if len(inputs) == 1 and (is_scene_file(inputs[0]) or _may_hold_images(inputs[0])):
        return
    for path in inputs:
        _check_wildcard(path)
    scene_files = [path for path in inputs if is_scene_file(path)]
    if scene_files:
        raise InputError(f"{scene_files[0]} is a scene file and must be the only input. Leave out the other inputs.")
    if len(inputs) < 2 and not (may_be_single and inputs and inputs[0].is_file()):
        given = f"only {inputs[0]} is given" if inputs else "none is given"
        if inputs and not (inputs[0].exists() or str(inputs[0]).startswith("/vsi")):
            raise InputError(f"There is no file {inputs[0]}. Check the path.")
        if inputs and inputs[0].suffix.lower() in TEXT_SUFFIXES:
            raise InputError(
                f"{inputs[0]} is no image. Give images, a scene.yaml, or the folder that a vendor delivered."
            )
        raise InputError(
            f"A surface needs two images or more, and {given}. Add images, or give a scene.yaml, or the folder that a "
            "vendor delivered."
        )
    seen = set()
    for path in inputs:
        if path.resolve() in seen:
            raise InputError(f"{path} is given twice, and an image cannot be matched with itself. Name it once.")
        seen.add(path.resolve())


def _may_hold_images(path: Path) -> bool:
    """Whether one input may be enough: a folder, an archive or a file of STAC."""
    return path.is_dir() or path.name.lower().endswith(CONTAINERS) or str(path).startswith(ARCHIVE_SYSTEMS)


def _check_wildcard(path: Path) -> None:
    """Refuse a wildcard that reached the program."""
    if not str(path).startswith("/vsi") and any(sign in str(path) for sign in "*?[") and not path.exists():
        matched = len(glob.glob(str(path)))
        raise InputError(
            f"{path} holds a wildcard that the shell did not replace by names ({matched} files match). Leave out the "
            "quotation marks around it."
            if matched
            else f"No file matches {path}. Check the path."
        )


def check_heights(heights: tuple[float, float] | None) -> None:
    """Refuse a range of heights that is empty or not finite."""
    if heights is None:
        return
    zmin, zmax = heights
    if not (math.isfinite(zmin) and math.isfinite(zmax)) or zmin >= zmax:
        raise ConfigError(f"--heights {zmin:.12g} {zmax:.12g} is an empty range. Give ZMIN ZMAX, the lower first.")


def check_bounds(bounds: tuple[float, float, float, float] | None) -> None:
    """Refuse bounds that hold no area or are not finite."""
    if bounds is None:
        return
    xmin, ymin, xmax, ymax = bounds
    if not all(map(math.isfinite, bounds)) or xmin >= xmax or ymin >= ymax:
        numbers = " ".join(f"{value:.12g}" for value in bounds)
        raise ConfigError(f"--bounds {numbers} holds no area. Give XMIN YMIN XMAX YMAX, the smaller values first.")


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Refuse a value of --name that is none of the choices."""
    if value not in choices:
        raise ConfigError(f"--{name} {value} is not known; choose from {', '.join(choices)}.")


def check_vertical(name: str, value: str) -> None:
    """Refuse a vertical datum that is neither one of `VERTICALS` nor a file."""
    if value.lower() not in VERTICALS and not Path(value).is_file():
        raise ConfigError(
            f"--{name} {value} is neither {', '.join(VERTICALS)} nor the file of a geoid. Check the name."
        )


def check_vertical_of(name: str, of: Path | None, value: str | None) -> None:
    """Refuse the vertical datum of a file that is not given, and one that is not known."""
    if value is None:
        return
    if of is None:
        raise ConfigError(f"--{name}-vertical {value} is given without --{name}. Give both, or leave it out.")
    check_vertical(f"{name}-vertical", value)


def check_workers(workers: int | None) -> None:
    """Refuse a number of workers below 1."""
    if workers is not None and workers < 1:
        raise ConfigError(f"--workers {workers} is too few; give 1 or more.")


def is_scene_file(path: Path) -> bool:
    """Whether a file is a scene file, by the end of its name."""
    return path.suffix.lower() in SCENE_SUFFIXES


def check_positive(name: str, value: float | None, unit: str) -> None:
    """Refuse a size that is not a finite number above 0."""
    if value is not None and not (math.isfinite(value) and value > 0):
        raise ConfigError(f"{name} {value:g} is not a size. Give a number of {unit} above 0.")
