"""What every kind of run does before and around its matching: CRS, first heights, orientation, the output folder."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from zlocus.core.errors import ConfigError, CoverageError, GeometryError, OutputError
from zlocus.core.options import OrientationOptions
from zlocus.core.progress import Progress
from zlocus.core.resources import cores
from zlocus.core.scene import Scene, View, check_overlap, footprint, ground_sample_distance, is_local, is_shared
from zlocus.core.sensor_model import capped, lowest_station
from zlocus.io.crs import checked_crs
from zlocus.io.grid_inputs import says_nothing
from zlocus.io.scene_file import open_scene
from zlocus.io.vertical import VerticalDatum
from zlocus.matching.match_scene import height_step, shared_ground
from zlocus.orientation.control import GroundControl, TerrainHeights
from zlocus.orientation.orientation import RANGE_PERCENT, MeasuredTies, Orientation, height_range, orient, supported
from zlocus.orientation.plausibility import Doubt

HEIGHT_SAMPLES = 5
# Of the time that ties take, about: where it begins, and how much it is.
SHARES = {"features": (0.0, 0.4), "matches": (0.4, 0.35)}
MOST_NAMED = 12  # images, or doubts, in a message
PAIR = 2  # images that a height takes
# Ground lies between these on Earth.
LOWEST_M, HIGHEST_M = -500.0, 9000.0
# Depths below the lowest camera at which footprints are looked at, in equal ratios.
NEAREST_M, DEPTHS = 2.0, 49
# Of the depth of the lowest ground below the lowest camera: nothing is searched nearer than that.
CLEARANCE = 0.25
# The same where heights are asked for: a little more than what projection tables need.
LEAST_CLEARANCE = 0.125
# The area found from ties: added on all sides, as a share of their extent; and how many it takes.
AREA_MARGIN, FEWEST_FOR_AREA = 0.05, 20


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


def opened_alone(inputs: Sequence[Path], crs: str | None, heights: tuple[float, float] | None) -> Scene:
    """The scene of a stage that stands alone: its views by name, its heights (m) those asked for, where some are, and
    found to overlap, as far as heights are known.

    Raises
    ------
    InputError, ConfigError, GeometryError
        See `open_scene` and `check_overlap`.
    """
    scene = open_scene(inputs, asked_crs(crs))
    views = tuple(sorted(scene.views, key=lambda view: view.name))
    scene = replace(scene, views=views, heights=heights or scene.heights)
    if not is_local(scene.crs) or scene.heights is not None:
        check_overlap(scene, possible_heights(scene, scene.heights))
    return scene


def possible_heights(scene: Scene, given: tuple[float, float] | None) -> list[float]:
    """Heights (m) at which the scene may have ground, for a first look at overlaps. given : those asked for.

    Raises
    ------
    GeometryError
        Where neither the request nor the cameras tell.
    """
    if given is not None:
        return [float(z) for z in np.linspace(*given, HEIGHT_SAMPLES)]
    bounds = [b for view in scene.views if (b := view.sensor.height_bounds()) is not None]
    if not bounds:
        return [float(z) for z in np.linspace(*heights_below(scene), HEIGHT_SAMPLES)]
    low, high = max(b[0] for b in bounds), min(b[1] for b in bounds)
    return [float(z) for z in np.linspace(low, max(high, low), HEIGHT_SAMPLES)]


def with_heights(
    scene: Scene,
    asked: tuple[float, float] | None,
    vertical: VerticalDatum,
    bounds: Sequence[float] | None = None,
) -> Scene:
    """The scene with the ellipsoidal heights of a request, where it has some, to be searched.

    asked : (zmin, zmax) m above `vertical`; what is searched holds them wherever two views see the same ground, in
    `bounds` (None: in the area that the scene asks for, where it does).

    Raises
    ------
    GeometryError
        Where the frame is local, and nothing in it is above a geoid.
    """
    if vertical.geoid is not None and is_local(scene.crs):
        raise GeometryError(
            f"The scene's frame is local, where no place is above {vertical.surface}. Leave --vertical out."
        )
    if asked is None or vertical.geoid is None:
        return scene if asked is None else replace(scene, heights=asked)
    area = shared_ground(scene, asked)
    if inside := bounds or scene.bounds:
        west, south = max(area[0], inside[0]), max(area[1], inside[1])
        east, north = min(area[2], inside[2]), min(area[3], inside[3])
        area = (west, south, east, north) if west < east and south < north else area
    low, high = vertical.span(area, scene.crs)
    return replace(scene, heights=(asked[0] + low, asked[1] + high))


def heights_below(scene: Scene) -> tuple[float, float]:
    """Between which heights (m) two views see the same ground, of cameras that know where they stood and look down.

    Such a camera sees nothing above itself, and close below it too little for two to share: so the ground ends well
    below the lowest of them. How deep it lies is not known; the lowest land is.

    Raises
    ------
    GeometryError
        Where a camera does not know its place or sees as high as itself, or no two views see the same ground.
    """
    lowest = lowest_station(view.sensor for view in scene.views)
    ask = "give the range of heights that holds the ground: --heights ZMIN ZMAX, or heights: in the scene file"
    if lowest is None or any(_sees_as_high_as_itself(view) for view in scene.views):
        raise GeometryError(f"The cameras do not say at which heights the ground may be; {ask}.")
    deepest = max(lowest - LOWEST_M, 2 * NEAREST_M)
    depths = np.geomspace(deepest, NEAREST_M, DEPTHS)
    shared = [z for depth in depths if is_shared(scene, z := float(lowest - depth))]
    if not shared:
        raise GeometryError(
            f"No two images see the same ground anywhere below the lowest camera, which is {lowest:.0f} m high. "
            f"Check the positions and angles of the cameras; if they are right, {ask}."
        )
    return shared[0], min(shared[-1], HIGHEST_M)


def _sees_as_high_as_itself(view: View) -> bool:
    """Whether some ray at the image's border does not go down."""
    height = lowest_station([view.sensor])
    assert height is not None, "callers make sure"
    return len(footprint(view, height + 1.0)) > 0


def oriented(
    scene: Scene,
    options: OrientationOptions,
    heights: tuple[float, float] | None,
    progress: Progress,
    control: GroundControl | None = None,
    terrain: TerrainHeights | None = None,
    threads: int | None = None,
    known: MeasuredTies | None = None,
) -> Orientation:
    """Tie points and corrections, with progress. control, terrain, known : see `orient`; threads : as many as there are
    cores unless told otherwise."""
    if heights is None and all(view.sensor.height_bounds() is None for view in scene.views):
        heights = heights_below(scene)
    with progress.stage("Tie points", 1.0) as stage:
        done = 0.0

        def report(what: str, share: float) -> None:
            nonlocal done
            first, part = SHARES[what]
            stage.advance(first + part * share - done)
            done = first + part * share

        with one_thread_below():
            return orient(scene, options, heights, report, control, terrain, threads or cores(), known)


@contextmanager
def one_thread_below() -> Iterator[None]:
    """OpenCV uses one thread meanwhile: what calls it runs in several."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def heights_of_ties(scene: Scene, orientation: Orientation, options: OrientationOptions) -> tuple[float, float]:
    """Heights (m) to search, from the ties (see `height_range`), and not close to a camera."""
    station = lowest_station(view.sensor for view in scene.views)
    return capped(height_range(orientation, options, station), station, CLEARANCE)


def area_to_match(
    scene: Scene, orientation: Orientation, z_range: tuple[float, float]
) -> tuple[float, float, float, float]:
    """Bounds (xmin, ymin, xmax, ymax), m: what the scene asks for, else the ground that two views see between two
    heights; in a local frame the part of it around the ties.

    Cameras of a local frame may look at a wall from the side and see what lies far behind it, at the lowest of the
    heights: there two footprints share many times the area of the wall.
    """
    if scene.bounds is not None:
        return scene.bounds
    shared = shared_ground(scene, z_range)
    ties = orientation.xyz[supported(orientation.xyz, orientation.sigma_z_m)]
    if not is_local(scene.crs) or len(ties) < FEWEST_FOR_AREA:
        return shared
    low, high = np.percentile(ties[:, :2], RANGE_PERCENT, axis=0)
    aside = AREA_MARGIN * (high - low)
    low, high = np.maximum(low - aside, shared[:2]), np.minimum(high + aside, shared[2:])
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1])) if (low < high).all() else shared


def heights_asked_for(
    scene: Scene, asked: tuple[float, float], progress: Progress, given: str = "The heights asked for"
) -> tuple[float, float]:
    """Heights (m) to search, as asked for; where they reach the cameras, those below, and a note that says so."""
    station = lowest_station(view.sensor for view in scene.views)
    found = capped(asked, station, LEAST_CLEARANCE)
    if found != asked:
        progress.note(
            f"{given}, {asked[0]:g} to {asked[1]:g} m, reach the lowest camera, which is {station:.1f} m high: "
            f"{found[0]:g} to {found[1]:.1f} m are searched."
        )
    return found


def note_dem(dem: Path | None, given: str | None, progress: Progress) -> None:
    """Say what the heights of a DEM are taken to be above where neither the request nor the DEM does."""
    if dem is not None and given is None and says_nothing(dem):
        progress.note(
            f"{dem} does not say what its heights are above: taken to be ellipsoidal. Where they are above a geoid, as "
            "those of most terrain models, give it with --dem-vertical egm96|egm2008|FILE."
        )


def taking_part(scene: Scene, orientation: Orientation) -> Scene:
    """The scene of the images that tie points support; the others take no part in the matching.

    Raises
    ------
    CoverageError
        Where fewer than two images are supported, so that nothing can be matched.
    GeometryError
        Where the reason is that all images look along the same line.
    """
    left_out = {each.name for each in orientation.left_out}
    views = tuple(view for view in scene.views if view.name not in left_out)
    if len(views) >= PAIR:
        return replace(scene, views=views)
    if all(view.sensor.height_bounds() is not None for view in scene.views):
        levels = possible_heights(scene, scene.heights)
        middle = levels[len(levels) // 2]
        height_step(scene.views, middle, ground_sample_distance(scene.views[0], middle), 1.0)  # refuses such images
    names = [view.name for view in scene.views]
    told = ", ".join(names[:MOST_NAMED]) + (f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else "")
    raise CoverageError(
        f"No two images are held together by tie points (looked at: {told}), so nothing was matched. Check that they "
        "show the same ground and that each camera belongs to its image; where cameras may be far off, set a larger "
        "orientation.max_pointing_px in --config."
    )


def note_orientation(orientation: Orientation, progress: Progress) -> None:
    """Say which corrections were applied, which images take no part, and what is doubtful."""
    progress.note(what_was_applied(orientation))
    for left_out in orientation.left_out[:MOST_NAMED]:
        progress.note(str(left_out))
    if len(orientation.left_out) > MOST_NAMED:
        progress.note(f"{len(orientation.left_out) - MOST_NAMED} more images take no part: see run.json.")
    note_doubts(orientation.doubts, progress)


def note_doubts(doubts: Sequence[Doubt], progress: Progress) -> None:
    """Say what is doubtful."""
    for doubt in doubts[:MOST_NAMED]:
        progress.note(doubt.sentence)
    if len(doubts) > MOST_NAMED:
        progress.note(f"There are {len(doubts) - MOST_NAMED} more doubts about the cameras: see run.json.")


def check_doubts(doubts: Sequence[Doubt], made: Path) -> None:
    """Refuse to call a run a success whose heights are likely to be wrong. made : what was written all the same.

    Raises
    ------
    CoverageError
        With the first of the grave doubts.
    """
    grave = [doubt for doubt in doubts if doubt.is_grave]
    if grave:
        raise CoverageError(
            f"The heights in {made} are likely to be wrong. {grave[0].sentence} Accept them with --partial."
        )


def what_was_applied(orientation: Orientation) -> str:
    """The corrections, in a sentence."""
    moved = [v for v in orientation.views if v.shift_px != (0.0, 0.0)]
    if orientation.joint is not None and orientation.joint.solution.is_held.all():
        return (
            f"Cameras left as delivered: {len(orientation.measured)} tie points show no errors beyond their noise, "
            f"{orientation.joint.solution.sigma0_px:.2f} px."
        )
    if not moved:
        return "Pointing: no correction applied."
    if len(moved) <= MOST_NAMED:
        named = ", ".join(f"{v.name} ({v.shift_px[0]:+.2f}, {v.shift_px[1]:+.2f})" for v in moved)
        by = f"px (column, row): {named}."
    else:
        farthest = max(moved, key=lambda v: math.hypot(*v.shift_px))
        by = f"up to {math.hypot(*farthest.shift_px):.2f} px ({farthest.name})."
    if orientation.joint is not None:
        return (
            f"Cameras corrected jointly from {len(orientation.measured)} tie points, to "
            f"{orientation.joint.solution.sigma0_px:.2f} px; their images moved by, {by}"
        )
    return f"Pointing corrected from {len(orientation.xyz)} tie points, {by}"


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
