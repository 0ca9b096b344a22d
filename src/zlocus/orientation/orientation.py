"""Orientation of a scene: tie points, their refinement, the correction of the cameras, and what is left of
residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from zlocus.core.options import OrientationOptions
from zlocus.core.scene import Scene, is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.orientation.control import GroundControl, TerrainHeights
from zlocus.orientation.corrections import CameraSolver, excluded_images_of, without_contradicting_images
from zlocus.orientation.line_adjustment import estimated_line_shifts, no_line_shifts, without_line_shifts
from zlocus.orientation.parameter_groups import needs_bundle_adjustment
from zlocus.orientation.plausibility import Doubt, ExcludedImage, doubts_about
from zlocus.orientation.tie_heights import supported
from zlocus.orientation.tie_points import first_ground_points, with_rough_ties
from zlocus.orientation.tie_refinement import RefinedTies, refine_ties
from zlocus.orientation.tie_residuals import PairOrientation, ViewOrientation, pair_orientations, view_orientations
from zlocus.orientation.ties import Progress, find_ties, sift_tolerance_factor
from zlocus.orientation.triangulate import Observations, ground_jacobian
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.line_shifts import StraightenedImage

if TYPE_CHECKING:
    from zlocus.orientation.bundle_adjustment import BundleAdjustment

# Share of `inlier_px` that counts for refined ties.
INLIER_SHARE_OF_REFINED_TIES = 0.5
# Where poses are corrected, ties may lie this many times farther from one common shift of their pair.
POSE_TOLERANCE_FACTOR = 3.0
# Largest number of searches for ties where a self-calibration changes the cameras that they are searched with.
MAX_SEARCHES = 3


@dataclass(frozen=True)
class OrientationRequest:
    """What is known before an orientation.

    z_range_hint : heights (m) that hold the ground, where they are known; else those of the scene. control, terrain :
    used by the bundle adjustment. refined_ties : of an earlier orientation of the same scene; the images are not read
    then.
    """

    z_range_hint: tuple[float, float] | None = None
    control: GroundControl | None = None
    terrain: TerrainHeights | None = None
    refined_ties: RefinedTies | None = None


@dataclass(frozen=True)
class Orientation:
    """Corrections of the cameras, and the ties they rest on.

    xyz : (n, 3) m, ground points of the ties, with the corrections applied; sigma_z_m : (n,) standard deviations of
    their heights; observations : their image points, without the displacements of lines. model : the kind of correction
    (shift, joint or none); n_determined : how many directions of the corrections the ties determine (of the shifts' 2 i
    components, or of the bundle adjustment's parameters). z_bounds : heights (m) within which ties were searched.
    n_refined : the first so many ties were refined and agree with the adjustment, the others were not, see
    `with_rough_ties`. bundle_adjustment : None where none was made. refined_ties : the measurements in the images.
    excluded_images : images that take no part in the matching. doubts : about the cameras.
    """

    views: tuple[ViewOrientation, ...]
    pairs: tuple[PairOrientation, ...]
    xyz: FloatArray
    sigma_z_m: FloatArray
    observations: Observations
    model: str
    n_determined: int
    z_bounds: tuple[float, float]
    n_refined: int
    bundle_adjustment: BundleAdjustment | None = None
    refined_ties: RefinedTies | None = None
    excluded_images: tuple[ExcludedImage, ...] = ()
    doubts: tuple[Doubt, ...] = ()

    def __repr__(self) -> str:
        """The orientation in one line, because ties are thousands."""
        before, after = (
            max(
                (m for view in self.views if np.isfinite(m := getattr(view, f"residuals_{when}").median)),
                default=np.nan,
            )
            for when in ("before", "after")
        )
        return (
            f"Orientation({self.model}, {len(self.views)} views, {len(self.xyz)} ties; largest median residual "
            f"{after:.3f} px, before {before:.3f} px)"
        )

    @property
    def refined_xyz(self) -> FloatArray:
        """Ground points (k, 3) m of the refined ties, which look alike in the images that see them."""
        return self.xyz[: self.n_refined]

    def apply(self, scene: Scene) -> Scene:
        """The scene with corrected sensors, and with images whose lines lie where the sensors say."""
        views = []
        for number, (view, found) in enumerate(zip(scene.views, self.views, strict=True)):
            sensor, image = view.sensor, view.image
            if self.bundle_adjustment is not None:
                sensor = self.bundle_adjustment.sensors[number]
            elif found.shift_px != (0.0, 0.0):
                sensor = ShiftedModel(sensor, *found.shift_px)
            if found.line_shifts is not None:
                image = StraightenedImage(image, found.line_shifts)
            is_as_before = sensor is view.sensor and image is view.image
            views.append(view if is_as_before else replace(view, sensor=sensor, image=image))
        return replace(scene, views=tuple(views))

    @property
    def unobservable(self) -> str:
        """A sentence that says what the ties cannot determine."""
        if self.model == "none":
            return "No correction was requested: the models are used as delivered."
        total, untied = 2 * len(self.views), [v.name for v in self.views if not v.n_ties]
        unlinked = f" Without ties, so not corrected: {', '.join(untied)}." if untied else ""
        if self.bundle_adjustment is not None:
            total = len(self.bundle_adjustment.solution.parameters)
            return (
                f"The ties show {self.n_determined} of {total} directions of the cameras' parameters; along the other "
                f"{total - self.n_determined}, such as a common motion of all cameras and the ground, they stay where "
                f"what was delivered, and control, put them.{unlinked}"
            )
        text = (
            f"The ties show {self.n_determined} of the {total} components of the shifts; the other "
            f"{total - self.n_determined} are left at zero: a common translation of the ground and, where only two "
            "images overlap, the shift along the epipolar curve, which is a height."
        )
        return text + unlinked

    def as_dict(self) -> dict[str, Any]:
        """The orientation for run.json."""
        return {
            "views": {
                v.name: {
                    "sensor": v.sensor,
                    "shift_px": [round(v.shift_px[0], 4), round(v.shift_px[1], 4)],
                    "n_ties": v.n_ties,
                    "residual_before_px": v.residuals_before.as_dict(),
                    "residual_after_px": v.residuals_after.as_dict(),
                    "line_shifts_px": None if v.line_shifts is None else v.line_shifts.as_dict(),
                }
                for v in self.views
            },
            "pairs": [
                {
                    "views": list(p.views),
                    "n_ties": p.n_ties,
                    "epipolar_distance_before_px": round(p.epipolar_distance_before_px, 4),
                    "epipolar_distance_after_px": round(p.epipolar_distance_after_px, 4),
                }
                for p in self.pairs
            ],
            "model": self.model,
            "n_ties": len(self.xyz),
            "unobservable": self.unobservable,
            "excluded_images": {each.name: each.reason for each in self.excluded_images},
            "doubts": [doubt.as_dict() for doubt in self.doubts],
        }


def orient(
    scene: Scene,
    options: OrientationOptions,
    request: OrientationRequest | None = None,
    progress: Progress | None = None,
    threads: int = 1,
) -> Orientation:
    """Correct the cameras of a scene by tie points: one shift per image, or a bundle adjustment of all cameras.

    Ties are found by SIFT, refined by least squares in the full-resolution images, and adjusted together with their
    ground points (method section 1). The result does not depend on the number of threads.

    Raises
    ------
    ConfigError
        A self-calibration is to correct a parameter that a camera does not have.
    """
    request = OrientationRequest() if request is None else request
    options = _with_model(options, scene)
    if options.model == "joint":
        from zlocus.orientation.self_calibration import check_self_calibration

        check_self_calibration(scene.views, options)
    strict = replace(options, inlier_px=options.inlier_px * INLIER_SHARE_OF_REFINED_TIES)
    solver = CameraSolver(scene, strict, options.model == "joint", request.control, request.terrain)
    refined = request.refined_ties
    if refined is None:
        refined = _measure_ties(scene, options, request.z_range_hint, progress, threads)
        if solver.uses_bundle_adjustment and options.bundle_adjustment.self_calibration:
            refined = _measured_by_calibrated_cameras(solver, refined, options, request.z_range_hint, threads)
    ties, xyz = refined.ties, first_ground_points(scene, refined.ties)
    cameras, wrong, contradictions = without_contradicting_images(solver, refined.observations, xyz)
    line_shifts = no_line_shifts(scene.views)
    if options.line_shifts and options.model != "none":
        line_shifts = estimated_line_shifts(scene.views, cameras.adjustment)
    if any(line_shifts):
        straight = without_line_shifts(refined.observations, line_shifts)
        cameras, wrong, contradictions = without_contradicting_images(solver, straight, xyz)
    adjustment, sensors = cameras.adjustment, cameras.sensors
    rough = without_line_shifts(ties.observations.kept(~np.isin(ties.observations.view, wrong)), line_shifts)
    rough_inlier_px = options.inlier_px * sift_tolerance_factor(scene.views, options)
    tie_points = with_rough_ties(adjustment, sensors, rough, xyz, rough_inlier_px)
    views = view_orientations(scene.views, adjustment, sensors, line_shifts)
    heights = tie_points.xyz[supported(tie_points.xyz, tie_points.sigma_z_m), 2]
    off = [v.residuals_after.median for v in views], [v.shift_px for v in views]
    return Orientation(
        views=views,
        pairs=pair_orientations(scene, sensors, adjustment, ties.z_range),
        xyz=tie_points.xyz,
        sigma_z_m=tie_points.sigma_z_m,
        observations=tie_points.observations,
        model=options.model,
        n_determined=adjustment.n_determined,
        z_bounds=ties.z_range,
        n_refined=len(adjustment.ground_points.xyz),
        bundle_adjustment=cameras.bundle_adjustment,
        refined_ties=refined,
        excluded_images=excluded_images_of(scene, ties.observations, wrong, options),
        doubts=(*contradictions, *doubts_about(scene.views, *off, heights, options.model != "none")),
    )


def _with_model(options: OrientationOptions, scene: Scene) -> OrientationOptions:
    """The options with the correction that "auto" stands for.

    Cameras of a local frame come from an adjustment of their own, and nothing but ties would hold them in place: they
    are left as they are.
    """
    if options.model != "auto":
        return options
    if not needs_bundle_adjustment(scene.views):
        return replace(options, model="shift")
    return replace(options, model="none" if is_local(scene.crs) else "joint")


def _measure_ties(
    scene: Scene,
    options: OrientationOptions,
    z_range_hint: tuple[float, float] | None,
    progress: Progress | None,
    threads: int,
) -> RefinedTies:
    """Find the ties of a scene in its images, and refine them."""
    may_move_poses = options.model == "joint" and needs_bundle_adjustment(scene.views)
    factor = POSE_TOLERANCE_FACTOR if may_move_poses else 1.0
    ties = find_ties(scene, replace(options, inlier_px=options.inlier_px * factor), z_range_hint, progress, threads)
    jacobian = ground_jacobian(
        [view.sensor for view in scene.views], ties.observations, first_ground_points(scene, ties)
    )
    observations = refine_ties(scene.views, ties.observations, jacobian, options, threads)
    return RefinedTies(replace(ties, pairs=()), observations)


def _measured_by_calibrated_cameras(
    solver: CameraSolver,
    refined_ties: RefinedTies,
    options: OrientationOptions,
    z_range_hint: tuple[float, float] | None,
    threads: int,
) -> RefinedTies:
    """Ties that are searched again where a self-calibration shows that the cameras of the search were wrong.

    Features far from the epipolar curves of the stated lens are no ties. Those near the borders, which tell most about
    a lens, are then missing, and a few that agree by chance take their place. The poses of all searches are those that
    were delivered.
    """
    from zlocus.orientation.self_calibration import interior_change_px

    scene, searched = solver.scene, solver.scene
    for _ in range(MAX_SEARCHES - 1):
        xyz = first_ground_points(scene, refined_ties.ties)
        cameras, _, _ = without_contradicting_images(solver, refined_ties.observations, xyz)
        assert cameras.bundle_adjustment is not None, "callers make sure"
        sensors = cameras.bundle_adjustment.with_calibration_alone([view.sensor for view in scene.views])
        views = tuple(replace(view, sensor=sensor) for view, sensor in zip(scene.views, sensors, strict=True))
        middle_m = sum(refined_ties.ties.z_range) / 2
        if interior_change_px(searched.views, views, middle_m) <= POSE_TOLERANCE_FACTOR * options.inlier_px:
            break
        searched = replace(scene, views=views)
        refined_ties = _measure_ties(searched, options, z_range_hint, None, threads)
    return refined_ties
