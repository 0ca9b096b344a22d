"""Control of `zlocus orient` from an ortho-photo and a terrain model: images are compared with them before the cameras
are corrected."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import GeometryError, InputError
from zlocus.core.options import OrientationOptions
from zlocus.core.orient_request import OrientRequest
from zlocus.core.progress import Progress
from zlocus.core.scene import Scene, is_local
from zlocus.io.grid_inputs import dem_datum
from zlocus.io.ground_reference import OrthoReference, TerrainModel, open_reference
from zlocus.orientation.control import GroundControl
from zlocus.orientation.ground_match import (
    GroundMatches,
    NoGroundMatch,
    heights_of,
    lattice_spacing,
    match_to_ground,
)
from zlocus.orientation.ortho_control import control_of_matches
from zlocus.pipeline.height_range import possible_heights
from zlocus.pipeline.messages import note_dem, some_names
from zlocus.pipeline.setup import opencv_in_one_thread


@dataclass(frozen=True, eq=False)
class OrthoControl:
    """Control from an ortho-photo. control : its points; found : what was found in each image, by its name, for
    orientation.json."""

    control: GroundControl
    found: dict[str, Any]


def ortho_control(
    request: OrientRequest, scene: Scene, options: OrientationOptions, progress: Progress
) -> OrthoControl:
    """Compare the images of a scene with the ortho-photo and the terrain model of a request.

    Raises
    ------
    GeometryError
        The frame of the scene is local, where an ortho-photo has no place.
    InputError
        The ortho-photo or the terrain model cannot be used, or no image shows the place of the ortho-photo.
    """
    assert request.control_ortho is not None, "callers make sure"
    assert request.control_dem is not None, "the request makes sure"
    if is_local(scene.crs):
        raise GeometryError(
            f"The scene's frame is local, where {request.control_ortho} has no place. Leave --control-ortho out."
        )
    note_dem(request.control_dem, request.control_vertical, progress, "--control-vertical")
    terrain = TerrainModel(request.control_dem, dem_datum(request.control_dem, request.control_vertical))
    reference = open_reference(request.control_ortho, scene.crs, terrain)
    z_range = heights_of(reference, scene.crs)
    if z_range is None:
        raise InputError(
            f"The terrain model {request.control_dem} has no height where the ortho-photo {request.control_ortho} "
            "lies. Give one that covers it."
        )
    spacing_m = float(np.median([lattice_spacing(view, z_range, reference.cell_m) for view in scene.views]))
    results = _compared(scene, reference, options, spacing_m, progress)
    matches = {number: each for number, each in results.items() if isinstance(each, GroundMatches)}
    missing = {scene.views[number].name: each for number, each in results.items() if isinstance(each, NoGroundMatch)}
    if not matches:
        raise InputError(another_place(request.control_ortho, reference, missing, scene))
    control = control_of_matches(scene.views, matches, options.bundle_adjustment.sigma_dem_m)
    found = {scene.views[number].name: match_record(each) for number, each in matches.items()}
    found |= {name: {"n_points": 0, "reason": f"it {each.reason}"} for name, each in missing.items()}
    for sentence in what_was_found(request.control_ortho, control, matches, missing, scene):
        progress.note(sentence)
    return OrthoControl(control, found)


def _compared(
    scene: Scene, reference: OrthoReference, options: OrientationOptions, spacing_m: float, progress: Progress
) -> dict[int, GroundMatches | NoGroundMatch]:
    """What each image, by its number, has in common with the ortho-photo."""
    found = {}
    with progress.stage("Ortho-photo", len(scene.views)) as stage, opencv_in_one_thread():
        for number, view in enumerate(scene.views):
            # GDAL warps the terrain model, and must not do so in several threads: see `OrthoReference.is_in_frame`.
            found[number] = match_to_ground(view, reference, scene.crs, options, spacing_m)
            stage.advance()
    return found


def match_record(matches: GroundMatches) -> dict[str, Any]:
    """What was found in one image, for orientation.json."""
    return {
        "n_points": len(matches),
        "n_windows": matches.n_windows,
        "offset_px": [round(float(each), 3) for each in matches.offset_px],
        "rms_px": round(matches.rms_px, 4),
    }


def what_was_found(
    path: Path,
    control: GroundControl,
    matches: dict[int, GroundMatches],
    missing: dict[str, NoGroundMatch],
    scene: Scene,
) -> list[str]:
    """Sentences on the points found in an ortho-photo."""
    lengths = [float(np.hypot(*each.offset_px)) for each in matches.values()]
    n_check = int(control.is_check.sum())
    sentences = [
        f"{path}: {len(control) - n_check} control and {n_check} check points in {len(matches)} of "
        f"{len(scene.views)} images, whose cameras point {min(lengths):.1f} to {max(lengths):.1f} px past it."
    ]
    if missing:
        (first, reason), *_ = missing.items()
        sentences.append(
            f"{some_names(list(missing))}: no control from {path} ({first} {reason.reason}); tie points alone correct "
            "their cameras."
        )
    return sentences


def another_place(path: Path, reference: OrthoReference, missing: dict[str, NoGroundMatch], scene: Scene) -> str:
    """The sentence that refuses an ortho-photo of another place."""
    if all(each.is_elsewhere for each in missing.values()):
        west, south, east, north = reference.area
        x, y = np.mean([_middle_of(scene, number) for number in range(len(scene.views))], axis=0)
        return (
            f"The ortho-photo {path} shows another place than the images: it covers E {west:.0f} to {east:.0f} m, "
            f"N {south:.0f} to {north:.0f} m, and the images show the ground around E {x:.0f} m, N {y:.0f} m "
            f"({scene.crs.to_string()}). Give one of the same place, or check its CRS."
        )
    name, each = next((name, each) for name, each in missing.items() if not each.is_elsewhere)
    return (
        f"The ortho-photo {path} seems to show another place than the images: none of them agrees with it ({name} "
        f"{each.reason}). Check that both show the same place, and the CRS of the ortho-photo; where cameras may be "
        "farther off, set a larger orientation.max_pointing_px with --set."
    )


def _middle_of(scene: Scene, number: int) -> tuple[float, float]:
    """Easting and northing (m) of the middle of an image."""
    levels = possible_heights(scene, scene.heights)
    view = scene.views[number]
    rows, cols = view.image.shape
    xyz = view.sensor.ground_from_image(
        np.array([[(cols - 1) / 2, (rows - 1) / 2]]), np.array([levels[len(levels) // 2]], float)
    )
    return float(xyz[0, 0]), float(xyz[0, 1])
