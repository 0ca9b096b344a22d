"""Correction of the cameras of a scene by its ties, without the images that contradict the others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import OrientationOptions
from zlocus.core.scene import Scene
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.orientation.control import GroundControl, TerrainHeights
from zlocus.orientation.plausibility import (
    MIN_AGREEING_IMAGES,
    Doubt,
    ExcludedImage,
    agreeing_shares,
    contradicting_views,
    exchanged_views,
    untied_images,
)
from zlocus.orientation.shift_adjustment import Adjustment, adjust, with_most_images_in_place
from zlocus.orientation.triangulate import Observations

if TYPE_CHECKING:
    from zlocus.orientation.bundle_adjustment import BundleAdjustment


@dataclass(frozen=True)
class CorrectedCameras:
    """Corrected cameras of a scene.

    adjustment : of the ties; sensors : corrected, but for the shifts of `adjustment`; bundle_adjustment : None where
    each image was only shifted.
    """

    adjustment: Adjustment
    sensors: list[SensorModel]
    bundle_adjustment: BundleAdjustment | None = None


@dataclass(frozen=True)
class CameraSolver:
    """Correction of the cameras of a scene by ties.

    uses_bundle_adjustment : False gives one shift per image; control, terrain : for the bundle adjustment.
    """

    scene: Scene
    options: OrientationOptions
    uses_bundle_adjustment: bool
    control: GroundControl | None
    terrain: TerrainHeights | None

    def __call__(self, observations: Observations, xyz: FloatArray) -> CorrectedCameras:
        """Correct the cameras. observations, xyz : of the ties, with first ground points (n, 3) m."""
        views, options = self.scene.views, self.options
        sensors = [view.sensor for view in views]
        if self.uses_bundle_adjustment:
            # SciPy's sparse matrices and linear algebra cost 0.2 s to import.
            from zlocus.orientation.bundle_adjustment import adjust_bundle

            bundle_adjustment = adjust_bundle(views, observations, xyz, options, self.control, self.terrain)
            return CorrectedCameras(bundle_adjustment.adjustment, list(bundle_adjustment.sensors), bundle_adjustment)
        adjustment = adjust(sensors, observations, xyz, options)
        if np.hypot(*adjustment.shift_px.T).max(initial=0.0) > options.max_pointing_px:
            adjustment = with_most_images_in_place(sensors, adjustment, options)
        return CorrectedCameras(adjustment, sensors)


def without_contradicting_images(
    solver: CameraSolver, observations: Observations, xyz: FloatArray
) -> tuple[CorrectedCameras, NDArray[np.int64], list[Doubt]]:
    """Corrected cameras without the images that contradict the others, the numbers of these images, and doubts.

    Where too few images agree with each other, all are kept, and a doubt says so. observations, xyz : see
    `CameraSolver`.
    """
    cameras, nobody = solver(observations, xyz), np.empty(0, np.int64)
    names = [view.name for view in solver.scene.views]
    shares = agreeing_shares(observations, cameras.adjustment, len(names))
    wrong = contradicting_views(shares)
    n_tied = len(np.unique(observations.view))
    if solver.options.model == "none" or not n_tied:
        return cameras, nobody, []
    doubts = []
    sensors = [view.sensor for view in solver.scene.views]
    # Among more images, those whose cameras are exchanged contradict the others.
    candidates = np.unique(observations.view) if n_tied <= MIN_AGREEING_IMAGES else wrong
    pair = (
        exchanged_views(sensors, observations, xyz, candidates.tolist(), solver.options)
        if len(candidates) > 1
        else None
    )
    if pair is not None:
        one, other = (names[number] for number in pair)
        doubts.append(
            Doubt(
                f"The cameras of {one} and {other} seem to be exchanged: with each other's, the tie points agree. Give "
                "each image its own.",
                is_grave=True,
            )
        )
    if not len(wrong):
        return cameras, nobody, doubts
    rest = ~np.isin(observations.view, wrong)
    rest &= np.bincount(observations.point[rest], minlength=len(xyz))[observations.point] >= 2
    if len(np.unique(observations.view[rest])) >= MIN_AGREEING_IMAGES:
        others = observations.kept(rest)
        again = solver(others, xyz)
        if not len(contradicting_views(agreeing_shares(others, again.adjustment, len(names)))):
            return again, wrong, [replace(doubt, is_grave=False) for doubt in doubts]
    shares_by_name = ", ".join(f"{names[number]} ({100 * shares[number]:.0f} %)" for number in wrong)
    doubts.append(
        Doubt(
            f"Only a part of the tie points of {shares_by_name} agrees with the other images, and too few images agree "
            "for it to be known which cameras are wrong. Check that each camera belongs to its image.",
            is_grave=True,
        )
    )
    return cameras, nobody, doubts


def excluded_images_of(
    scene: Scene, observations: Observations, wrong: NDArray[np.int64], options: OrientationOptions
) -> tuple[ExcludedImage, ...]:
    """Images that take no part in the matching, with the reasons.

    observations : of all ties; wrong : numbers of the images that contradict the others.
    """
    untied = untied_images(observations, len(scene.views))
    excluded = []
    for number, view in enumerate(scene.views):
        if number in wrong:
            reason = (
                "most of its tie points contradict those of the other images, which agree with each other. Check that "
                "its camera belongs to it."
            )
        elif untied[number]:
            reason = (
                f"no tie point with another image supports it, within {options.max_pointing_px:g} px of where its "
                "camera points. Check that it shows the same ground and that its camera belongs to it."
            )
        else:
            continue
        excluded.append(ExcludedImage(view.name, reason))
    return tuple(excluded)
