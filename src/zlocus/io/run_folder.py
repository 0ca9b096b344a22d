"""What a folder holds: a finished surface, or what else, in words."""

from __future__ import annotations

import warnings
from pathlib import Path

from zlocus.core.errors import InputError, ZlocusWarning
from zlocus.core.requests import DEMO_BEGUN, FINISHED

RECORD = "run.json"
SURFACE_RASTERS = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif")
# Of an interrupted run: its finished tiles.
MANIFEST = Path("tiles") / "manifest.json"
# Files by which the result of another command is known: what it is, and the command that makes it.
OTHER_RESULTS = {
    "cloud.laz": ("a point cloud", "zlocus cloud"),
    "cloud.ply": ("a point cloud", "zlocus cloud"),
    "point.json": ("match curves of one point", "zlocus curves"),
    "ranking.json": ("a ranking of images", "zlocus rank"),
    "export.json": ("an export", "zlocus export"),
    "orientation.json": ("tie points and corrected cameras", "zlocus orient` or `zlocus ties"),
    "evaluation.json": ("an evaluation", "zlocus evaluate"),
    "compare.html": ("a comparison", "zlocus compare"),
    "change.json": ("a change between two surfaces", "zlocus change"),
    "scene.yaml": ("a scene, which is an input", "zlocus import"),
}
ADVICE = "Give the folder that a finished `zlocus dsm` wrote (-o)."


def check_surface(folder: Path) -> None:
    """Refuse a folder that holds no surface, and say what it holds.

    A surface whose rasters are complete, but whose run did not come to its end, causes a warning.

    Raises
    ------
    InputError
        The folder does not exist, is a file, or holds no complete surface.
    """
    if not folder.exists():
        raise InputError(f"There is no folder {folder}. {ADVICE}")
    if not folder.is_dir():
        raise InputError(f"{folder} is a file. {ADVICE}")
    missing = [name for name in (*SURFACE_RASTERS, RECORD) if not (folder / name).is_file()]
    is_interrupted = (folder / MANIFEST).is_file() and not (folder / FINISHED).is_file()
    if not missing:
        if is_interrupted:
            warnings.warn(
                f"The run in {folder} did not come to its end: tiles failed and are empty (FAILED in quality.tif), or "
                "it was stopped before its last product. Give the same command again to complete it.",
                ZlocusWarning,
                stacklevel=2,
            )
        return
    if is_interrupted:
        raise InputError(
            f"{folder} holds a run that has not finished; its finished tiles are in {folder / MANIFEST.parent}. Give "
            "the same command again to complete it."
        )
    raise InputError(_what_is_wrong(folder, missing))


def _what_is_wrong(folder: Path, missing: list[str]) -> str:
    """Why a folder without an interrupted run is no surface, as a sentence with advice."""
    if SURFACE_RASTERS[0] not in missing:
        return f"{folder} lacks {', '.join(missing)} of the surface. Give the same command again to have it made."
    for name, (what, command) in OTHER_RESULTS.items():
        if (folder / name).is_file():
            return f"{folder} holds {what} ({name}, of `{command}`) and no surface. {ADVICE}"
    if (folder / DEMO_BEGUN).is_file():
        return f"{folder} holds a demo, whose surface has not been finished. Run `zlocus demo` again."
    inner = sorted(path.parent for path in folder.glob("*/dsm.tif"))
    if inner:
        return f"{folder} holds no surface, but {inner[0]} may. Give that folder."
    return f"{folder} holds no run: there is no {SURFACE_RASTERS[0]} in it. {ADVICE}"
