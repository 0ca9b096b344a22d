"""The words of a command line of zlocus, from values as the dialogs give them. Nothing here is of QGIS."""

from __future__ import annotations

import os
import shlex
import shutil
from typing import Any, Mapping, Sequence

COMMAND = "zlocus"
# Variables by which QGIS finds its own Python and its own GDAL and PROJ, which are not those of the command.
OF_QGIS = (
    "PYTHONHOME", "PYTHONPATH", "PYTHONDONTWRITEBYTECODE", "PYTHONNOUSERSITE", "GDAL_DATA", "GDAL_DRIVER_PATH",
    "GDAL_PYTHON_DRIVER_PATH", "PROJ_LIB", "PROJ_DATA", "PROJ_NETWORK", "QT_PLUGIN_PATH", "LD_LIBRARY_PATH",
    "DYLD_LIBRARY_PATH", "DYLD_FRAMEWORK_PATH",
)  # fmt: skip
# Figures of an evaluation.
FIGURES = {"median": "median", "NMAD": "nmad", "RMSE": "rmse", "LE90": "le90"}
# A folder of a run is known by these files.
RECORD, HEIGHTS = "run.json", "dsm.tif"


class WrongValue(ValueError):
    """A value of a dialog that cannot be used, as a sentence."""


def found_command(setting: str, path: str | None = None) -> str:
    """The program to run: the one of the setting, else zlocus on PATH. path : in place of PATH.

    Raises
    ------
    WrongValue
        There is none.
    """
    given = os.path.expanduser(setting.strip())
    found = shutil.which(given or COMMAND, path=path)
    if found:
        return found
    if given:
        raise WrongValue(
            f"{given} is no program. Correct the path of the command zlocus in Settings > Options > Processing > "
            "Providers > zlocus."
        )
    raise WrongValue(
        "The command zlocus is not on PATH. Install it into an environment of Python 3.11 or newer, and give its path "
        "in Settings > Options > Processing > Providers > zlocus."
    )


def own_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment of the command: that of QGIS without what is meant for QGIS's own libraries."""
    kept = {name: value for name, value in environment.items() if name not in OF_QGIS}
    return {**kept, "PYTHONIOENCODING": "utf-8"}


def options_of(values: Mapping[str, Any]) -> list[str]:
    """The words of options: `--name value`, several of a list or tuple, none of None, "" and False, and only the name
    of True. Names have no hyphens before them."""
    words: list[str] = []
    for name, value in values.items():
        if value is None or value is False or value in ("", (), []):
            continue
        words.append(f"--{name}")
        if isinstance(value, (list, tuple)):
            words.extend(text_of(each) for each in value)
        elif value is not True:
            words.append(text_of(value))
    return words


def text_of(value: Any) -> str:
    """A value as a word; whole numbers have no decimals."""
    return str(int(value)) if isinstance(value, float) and value == int(value) else str(value)


def additional(text: str) -> list[str]:
    """The words of the field of additional options, quoted as in a shell.

    Raises
    ------
    WrongValue
        A quotation mark has no end.
    """
    try:
        return shlex.split(text or "")
    except ValueError as error:
        raise WrongValue(
            f"The additional options {text} cannot be read: {error}. Correct the quotation marks."
        ) from error


def command_line(
    program: str, command: str, arguments: Sequence[str], options: Mapping[str, Any], more: str = ""
) -> list[str]:
    """The whole command line. arguments : without a name; options : see `options_of`; more : additional options.

    `--json` is always asked for, so that results and errors can be read.

    Raises
    ------
    WrongValue
        The additional options cannot be read.
    """
    return [program, command, *arguments, *options_of(options), *additional(more), "--json"]


def inputs_of(files: Sequence[str], folder: str) -> list[str]:
    """Images, or a scene file, or the folder or archive of a delivery.

    Raises
    ------
    WrongValue
        There are none, or both.
    """
    if folder and files:
        raise WrongValue("Images and a delivery are given. Give one of them.")
    if not folder and not files:
        raise WrongValue("There are no images. Give two or more, a scene.yaml, or the folder or archive of a delivery.")
    return [folder] if folder else list(files)


def pair_of(low: float | None, high: float | None, what: str) -> tuple[float, float] | None:
    """Both ends of a range; None where neither is given.

    Raises
    ------
    WrongValue
        Only one is given.
    """
    if low is None and high is None:
        return None
    if low is None or high is None:
        raise WrongValue(f"Only one end of the {what} is given. Give both, or neither.")
    return low, high


def surface_of(path: str) -> str:
    """The folder of a run where its dsm.tif is given, so that runs are compared and not rasters alone."""
    folder = os.path.dirname(path)
    if os.path.basename(path) == HEIGHTS and os.path.isfile(os.path.join(folder, RECORD)):
        return folder
    return path


def utm_zone(longitude: float, latitude: float) -> str:
    """The UTM zone of a place on WGS 84, as EPSG:N."""
    zone = min(max(int((longitude + 180.0) // 6.0) + 1, 1), 60)
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"


def figures_in_words(figures: Mapping[str, Any]) -> str:
    """The main figures of an evaluation, in metres, as far as they are known."""
    known = [f"{name} {figures[key]:.3f} m" for name, key in FIGURES.items() if figures.get(key) is not None]
    if figures.get("completeness") is not None:
        known.append(f"completeness {100 * figures['completeness']:.1f} %")
    return f"Surface less reference: {', '.join(known)}."
