"""What every kind of run does before and around its matching: CRS, first heights, orientation, the output folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from zlocus.errors import ConfigError, OutputError
from zlocus.io.crs import checked_crs
from zlocus.options import OrientationOptions
from zlocus.orientation.orient import Orientation, orient
from zlocus.progress import Progress
from zlocus.scene import Scene

HEIGHT_SAMPLES = 5
UNBOUNDED_M = (-500.0, 9000.0)


def asked_crs(given: str | None) -> CRS | None:
    """The CRS of --crs.

    Raises
    ------
    ConfigError
        Where it is not known, or not projected in metres.
    """
    if given is None:
        return None
    try:
        return checked_crs(CRS.from_user_input(given))
    except CRSError as error:
        raise ConfigError(f"--crs {given} is not a known CRS. Give a projected one, such as EPSG:32632.") from error


def possible_heights(scene: Scene, given: tuple[float, float] | None) -> list[float]:
    """Heights (m) at which the scene may have ground, for a first look at overlaps. given : those asked for."""
    if given is not None:
        return [float(z) for z in np.linspace(*given, HEIGHT_SAMPLES)]
    bounds = [b for view in scene.views if (b := view.sensor.height_bounds()) is not None]
    low = max((b[0] for b in bounds), default=UNBOUNDED_M[0])
    high = min((b[1] for b in bounds), default=UNBOUNDED_M[1])
    return [float(z) for z in np.linspace(low, max(high, low), HEIGHT_SAMPLES)]


def oriented(
    scene: Scene, options: OrientationOptions, heights: tuple[float, float] | None, progress: Progress
) -> Orientation:
    """Tie points and corrections, with progress."""
    with progress.stage("Tie points", 1.0) as stage:
        done = 0.0

        def report(_: str, share: float) -> None:
            nonlocal done
            stage.advance(share - done)
            done = share

        return orient(scene, options, heights, report)


def what_was_applied(orientation: Orientation) -> str:
    """The corrections, in a sentence."""
    moved = [
        f"{v.name} ({v.shift_px[0]:+.2f}, {v.shift_px[1]:+.2f})" for v in orientation.views if v.shift_px != (0.0, 0.0)
    ]
    if not moved:
        return "Pointing: no correction applied."
    return f"Pointing corrected from {len(orientation.xyz)} tie points, px (column, row): {', '.join(moved)}."


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """A folder that is there; after a failure, what was made of it and its parents is removed again while empty."""
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder} cannot be made: {error.strerror}. Choose another folder with -o.") from error
    try:
        yield
    except BaseException:
        with suppress(OSError):  # where something lies in it
            for path in new:
                path.rmdir()
        raise
