"""Orientation: from a scene to corrected cameras, residuals before and after, and the height range of the ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import GeometryError
from zlocus.core.options import OrientationOptions
from zlocus.core.scene import Scene, View, is_local
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.orientation.control import GroundControl, TerrainHeights
from zlocus.orientation.corrections import CameraSolver, excluded_images_of, without_contradicting_images
from zlocus.orientation.epipolar import Sightlines, epipolar_offsets
from zlocus.orientation.parameter_groups import kind_of, needs_bundle_adjustment
from zlocus.orientation.plausibility import Doubt, ExcludedImage, doubts_about
from zlocus.orientation.shift_adjustment import Adjustment, without_outliers, moved, renumbered
from zlocus.orientation.tie_refinement import refined_ties
from zlocus.orientation.ties import Progress, Ties, find_ties, sift_tolerance_factor
from zlocus.orientation.triangulate import GroundPoints, Observations, ground_jacobian, rows_of_views, triangulate
from zlocus.sensors.correction import ShiftedModel

if TYPE_CHECKING:
    from zlocus.orientation.bundle_adjustment import BundleAdjustment

MAX_MARGIN_SHARE_OF_DEPTH = 0.15
MIN_TIES_FOR_RANGE = 20
POINTS_AT_ONCE = 4096
TIES_FOR_MEDIAN = 200  # ties of a pair whose distances are reported, about: up to twice as many
NEIGHBOURS = 8
MIN_AGREEING_NEIGHBOURS = 3
MAX_SLOPE = 1.5
MAX_HEIGHT_SIGMAS = 4.0
RANGE_PERCENT = (0.5, 99.5)
# Of `inlier_px`, for ties that were measured again.
INLIER_SHARE_OF_REFINED_TIES = 0.5
# How much farther from one common shift of a pair its ties may lie where more than shifts is corrected.
POSE_TOLERANCE_FACTOR = 3.0
# What is kept of ties.
TIES, OBSERVED = ("rough", "precise"), ("view", "point", "xy")
KD_TREE = 4  # FLANN's exact k-d tree (KDTreeSingleIndex), which is not a random one


@dataclass(frozen=True)
class Residuals:
    """Lengths of an image's tie residuals, px; NaN without ties."""

    median: float
    rms: float
    percent90: float

    @classmethod
    def of(cls, residual: FloatArray) -> Residuals:
        """Statistics of residuals (m, 2) px."""
        length = np.hypot(*residual.T)
        if not len(length):
            return cls(np.nan, np.nan, np.nan)
        return cls(float(np.median(length)), float(np.sqrt(np.mean(length**2))), float(np.percentile(length, 90)))

    def as_dict(self) -> dict[str, float | None]:
        """For run.json."""
        values = {"median": self.median, "rms": self.rms, "percent90": self.percent90}
        return {name: round(value, 4) if np.isfinite(value) else None for name, value in values.items()}


@dataclass(frozen=True)
class ViewOrientation:
    """What was found for one image: the shift (column, row) px added to what its model projects, or where more was
    corrected the median of that at its ties, and its residuals. sensor : see `blocks.kind_of`."""

    name: str
    shift_px: tuple[float, float]
    n_ties: int
    before: Residuals
    after: Residuals
    sensor: str = "rpc"


@dataclass(frozen=True)
class PairOrientation:
    """Ties of two images and their median distance from the loci, px, before and after the shifts."""

    views: tuple[str, str]
    n_ties: int
    epipolar_distance_before_px: float
    epipolar_distance_after_px: float


@dataclass(frozen=True)
class RefinedTies:
    """What an orientation takes from the images, and most of its time: rough ties as they were found, and their
    observations measured again by correlation."""

    rough: Ties
    precise: Observations

    def arrays(self) -> dict[str, NDArray[Any]]:
        """By name, to be kept; the matches of the pairs are not."""
        both = zip(TIES, (self.rough.observations, self.precise), strict=True)
        columns = {f"{name}_{part}": getattr(observations, part) for name, observations in both for part in OBSERVED}
        return {**columns, "z": self.rough.z, "z_range": np.array(self.rough.z_range)}

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]], n_views: int) -> RefinedTies | None:
        """What `arrays` gave; None of arrays that are not ties of so many views."""
        try:
            rough, precise = (Observations(*(arrays[f"{name}_{part}"] for part in OBSERVED)) for name in TIES)
            z, (low, high) = arrays["z"], arrays["z_range"]
        except (KeyError, ValueError):
            return None
        if not all(_fits(observations, n_views, len(z)) for observations in (rough, precise)):
            return None
        return cls(Ties(rough, z, (), (float(low), float(high))), precise)


def _fits(observations: Observations, n_views: int, n_points: int) -> bool:
    """Whether observations are of so many views and points."""
    if (
        observations.view.ndim != 1
        or observations.point.shape != observations.view.shape
        or observations.xy.shape != (len(observations), 2)
    ):
        return False
    numbers = ((observations.view, n_views), (observations.point, n_points))
    return all(v.dtype == np.int64 and v.min(initial=0) >= 0 and v.max(initial=-1) < n for v, n in numbers)


@dataclass(frozen=True)
class Orientation:
    """Pointing corrections and the ties they rest on.

    xyz : (n, 3) m, ground points of the ties with the shifts applied; sigma_z_m : (n,) their height precision;
    observations: their observations; model: the kind of correction; n_determined: how many of the shifts' 2 i components the ties
    could show; z_bounds: the heights (m) within which ties were looked for; n_refined: the first so many ties were
    measured again and agree, the others look different from everywhere, see `with_rough_ties`; joint: where all cameras
    were corrected jointly; ties: what was measured in the images; excluded_images: images that take no part in the matching;
    doubts: about the cameras.
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
    ties: RefinedTies | None = None
    excluded_images: tuple[ExcludedImage, ...] = ()
    doubts: tuple[Doubt, ...] = ()

    def __repr__(self) -> str:
        """In a line: ties are thousands."""
        before, after = (
            max((m for view in self.views if np.isfinite(m := getattr(view, when).median)), default=np.nan)
            for when in ("before", "after")
        )
        return (
            f"Orientation({self.model}, {len(self.views)} views, {len(self.xyz)} ties; largest median residual "
            f"{after:.3f} px, before {before:.3f} px)"
        )

    @property
    def refined_xyz(self) -> FloatArray:
        """(k, 3) m, the ties that look the same in the images that see them."""
        return self.xyz[: self.n_refined]

    def apply(self, scene: Scene) -> Scene:
        """The scene with corrected sensors."""
        if self.bundle_adjustment is not None:
            pairs = zip(scene.views, self.bundle_adjustment.sensors, strict=True)
            return replace(scene, views=tuple(replace(view, sensor=sensor) for view, sensor in pairs))
        views = []
        for view, found in zip(scene.views, self.views, strict=True):
            moved = found.shift_px != (0.0, 0.0)
            views.append(replace(view, sensor=ShiftedModel(view.sensor, *found.shift_px)) if moved else view)
        return replace(scene, views=tuple(views))

    @property
    def unobservable(self) -> str:
        """What the ties cannot tell, in a sentence."""
        if self.model == "none":
            return "No correction was asked for: the models are used as delivered."
        total, alone = 2 * len(self.views), [v.name for v in self.views if not v.n_ties]
        unlinked = f" Without ties, so not corrected: {', '.join(alone)}." if alone else ""
        if self.bundle_adjustment is not None:
            total = len(self.bundle_adjustment.solution.parameters)
            return (
                f"The ties show {self.n_determined} of {total} directions of the cameras' parameters; along the other "
                f"{total - self.n_determined}, such as a common motion of all cameras and the ground, they stay where "
                f"what was delivered, and control, put them.{unlinked}"
            )
        text = (
            f"The ties show {self.n_determined} of the {total} components of the shifts; the other {total - self.n_determined} are "
            "left at zero: a common translation of the ground and, where only two images overlap, the shift along the "
            "locus, which is a height."
        )
        return text + unlinked

    def as_dict(self) -> dict[str, Any]:
        """For run.json."""
        return {
            "views": {
                v.name: {
                    "sensor": v.sensor,
                    "shift_px": [round(v.shift_px[0], 4), round(v.shift_px[1], 4)],
                    "n_ties": v.n_ties,
                    "residual_before_px": v.before.as_dict(),
                    "residual_after_px": v.after.as_dict(),
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
    z_range_hint: tuple[float, float] | None = None,
    progress: Progress | None = None,
    control: GroundControl | None = None,
    terrain: TerrainHeights | None = None,
    threads: int = 1,
    known: RefinedTies | None = None,
) -> Orientation:
    """Tie points, measured again by correlation, then one shift per image, or all cameras, solved with the heights of
    the ties.

    z_range_hint: heights in m that hold the ground, where they are known; else the scene's. control, terrain : used
    where cameras are corrected jointly. Cameras of a local frame come from an adjustment of their own, and nothing but
    ties would hold them in place: `model` "auto" leaves them as they are. The result does not depend on the number of
    threads. known : of an earlier orientation of the same; images are not read then.
    """
    has_poses = needs_bundle_adjustment(scene.views)
    if options.model == "auto" and has_poses and is_local(scene.crs):
        options = replace(options, model="none")
    uses_bundle_adjustment = options.model == "joint" or (options.model == "auto" and has_poses)
    loosely = (
        replace(options, inlier_px=options.inlier_px * POSE_TOLERANCE_FACTOR)
        if uses_bundle_adjustment and has_poses
        else options
    )
    ties = find_ties(scene, loosely, z_range_hint, progress, threads) if known is None else known.rough
    sensors = [view.sensor for view in scene.views]
    xyz = first_ground(scene, ties)
    if known is None:
        jacobian = ground_jacobian(sensors, ties.observations, xyz)
        precise = refined_ties(scene.views, ties.observations, jacobian, options, threads)
        known = RefinedTies(replace(ties, pairs=()), precise)
    solve = CameraSolver(
        scene,
        replace(options, inlier_px=options.inlier_px * INLIER_SHARE_OF_REFINED_TIES),
        uses_bundle_adjustment,
        control,
        terrain,
    )
    solved, wrong, contradictions = without_contradicting_images(solve, known.precise, xyz)
    adjustment, corrected = solved.adjustment, solved.sensors
    observations = ties.observations.kept(~np.isin(ties.observations.view, wrong))
    ground = with_rough_ties(
        adjustment, corrected, observations, xyz, options.inlier_px * sift_tolerance_factor(scene.views, options)
    )
    views = tuple(view_orientation(view, i, adjustment, corrected[i]) for i, view in enumerate(scene.views))
    heights = ground.xyz[supported(ground.xyz, ground.sigma_z_m), 2]
    doubts = doubts_about(scene.views, [v.after.median for v in views], [v.shift_px for v in views], heights)
    return Orientation(
        views=views,
        pairs=pair_orientations(scene, corrected, adjustment, ties.z_range),
        xyz=ground.xyz,
        sigma_z_m=ground.sigma_z_m,
        observations=ground.observations,
        model="joint" if uses_bundle_adjustment else "none" if options.model == "none" else "shift",
        n_determined=adjustment.n_determined,
        z_bounds=ties.z_range,
        n_refined=len(adjustment.ground_points.xyz),
        bundle_adjustment=solved.bundle_adjustment,
        ties=known,
        excluded_images=excluded_images_of(scene, ties.observations, wrong, options),
        doubts=(*contradictions, *doubts),
    )


@dataclass(frozen=True)
class TiePoints:
    """xyz : (n, 3) m; sigma_z_m : (n,), their height precision; observations: their observations."""

    xyz: FloatArray
    sigma_z_m: FloatArray
    observations: Observations

    @classmethod
    def of(cls, ground_points: GroundPoints, observations: Observations) -> TiePoints:
        """Triangulated points with the noise that their residuals show."""
        sigma_px = np.sqrt(np.mean(ground_points.residual**2)) if len(observations) else np.nan
        return cls(ground_points.xyz, ground_points.sigma_z * sigma_px, observations)


def with_rough_ties(
    adjustment: Adjustment, sensors: Sequence[SensorModel], every: Observations, xyz: FloatArray, inlier_px: float
) -> TiePoints:
    """The adjusted ties, then those that could not be measured again, or not well enough to tell the pointing.

    sensors : those that the shifts of `adjustment` are to be laid over; every, xyz : all ties, observations and first
    ground points (n, 3) m. Tree tops and edges of roofs look different from everywhere: as SIFT found them they still
    tell where the search has to reach.
    """
    precise = TiePoints.of(adjustment.ground_points, adjustment.observations)
    used = np.zeros(len(xyz), bool)
    used[adjustment.numbers] = True
    rough, start = renumbered(every.kept(~used[every.point]), xyz)
    if not len(rough):
        return precise
    moved_rough = moved(rough, adjustment.shift_px)
    rough, start = renumbered(without_outliers(rough, triangulate(sensors, moved_rough, start), inlier_px), start)
    if not len(rough):
        return precise
    more = TiePoints.of(triangulate(sensors, moved(rough, adjustment.shift_px), start), rough)
    observations = Observations(
        np.concatenate([precise.observations.view, rough.view]),
        np.concatenate([precise.observations.point, rough.point + len(precise.xyz)]),
        np.concatenate([precise.observations.xy, rough.xy]),
    )
    return TiePoints(
        np.concatenate([precise.xyz, more.xyz]), np.concatenate([precise.sigma_z_m, more.sigma_z_m]), observations
    )


def first_ground(scene: Scene, ties: Ties) -> FloatArray:
    """Where each tie's first observation meets the tie's height, (n, 3) m."""
    xyz = np.full((len(ties.z), 3), np.nan)
    _, first = np.unique(ties.observations.point, return_index=True)
    for i, view in enumerate(scene.views):
        rows = first[ties.observations.view[first] == i]
        point = ties.observations.point[rows]
        xyz[point] = view.sensor.ground_from_image(ties.observations.xy[rows], ties.z[point])
    return xyz


def view_orientation(view: View, number: int, adjustment: Adjustment, corrected: SensorModel) -> ViewOrientation:
    """One image's share of the result. corrected : its sensor, but for its shift."""
    mine = adjustment.observations.view == number
    column, row = adjustment.shift_px[number]
    if corrected is not view.sensor and mine.any():
        xyz = adjustment.ground_points.xyz[adjustment.observations.point[mine]]
        column, row = np.nanmedian(corrected.image_from_ground(xyz) - view.sensor.image_from_ground(xyz), axis=0)
    before, after = Residuals.of(adjustment.before_px[mine]), Residuals.of(adjustment.after_px[mine])
    shift = (float(column), float(row))
    return ViewOrientation(view.name, shift, int(mine.sum()), before, after, kind_of(view.sensor))


def pair_orientations(
    scene: Scene, corrected: Sequence[SensorModel], adjustment: Adjustment, z_range: tuple[float, float]
) -> tuple[PairOrientation, ...]:
    """Each pair's distances from the loci, over ties that both its images see. corrected : the sensors, but for their
    shifts."""
    observations, found = adjustment.observations, []
    of_view = rows_of_views(observations, len(scene.views))
    for a, b in linked_pairs(observations, len(scene.views), len(adjustment.ground_points.xyz)):
        _, in_a, in_b = np.intersect1d(
            observations.point[of_view[a]], observations.point[of_view[b]], assume_unique=True, return_indices=True
        )
        few = slice(None, None, max(len(in_a) // TIES_FOR_MEDIAN, 1))
        xy_a, xy_b = observations.xy[of_view[a][in_a[few]]], observations.xy[of_view[b][in_b[few]]]
        first = Sightlines.of(scene.views[a].sensor, xy_a, z_range)
        before = epipolar_offsets(first, scene.views[b].sensor, xy_b, z_range).distance_px
        first = Sightlines.of(corrected[a], xy_a - adjustment.shift_px[a], z_range)
        after = epipolar_offsets(first, corrected[b], xy_b - adjustment.shift_px[b], z_range).distance_px
        names = (scene.views[a].name, scene.views[b].name)
        found.append(PairOrientation(names, len(in_a), median_distance(before), median_distance(after)))
    return tuple(found)


def linked_pairs(observations: Observations, n_views: int, n_points: int) -> NDArray[np.int64]:
    """Numbers (k, 2) of the views, the smaller first, that see some point together."""
    together = np.zeros((n_views, n_views), np.float32)
    for first in range(0, n_points, POINTS_AT_ONCE):
        here = (observations.point >= first) & (observations.point < first + POINTS_AT_ONCE)
        sees = np.zeros((n_views, POINTS_AT_ONCE), np.float32)
        sees[observations.view[here], observations.point[here] - first] = 1.0
        together += sees @ sees.T
    return np.argwhere(np.triu(together > 0, 1))


def median_distance(distance_px: FloatArray) -> float:
    """Median length of distances (n,) px from loci, where there are loci; else NaN."""
    known = distance_px[np.isfinite(distance_px)]
    return float(np.median(np.abs(known))) if len(known) else np.nan


def height_range(
    orientation: Orientation, options: OrientationOptions, station: float | None = None
) -> tuple[float, float]:
    """Lowest and highest height (m) to search, from the ties.

    The 0.5 to 99.5 percentiles of the ties that their neighbours confirm, widened at both ends by `range_margin` times
    their span (peaks and valleys between ties), then by `range_up_m` above (towers and trees carry few ties) and
    `range_down_m` below, but by no more than `MAX_MARGIN_SHARE_OF_DEPTH` of the depth below `station`, the height of the lowest camera
    (m), where that is known: a drone flies higher than the things it sees. Too wide costs time at the coarsest level
    only, and of a drone the tables' accuracy; too narrow costs the tower.
    """
    trusted = supported(orientation.xyz, orientation.sigma_z_m)
    if trusted.sum() < MIN_TIES_FOR_RANGE:
        raise GeometryError(
            f"Only {int(trusted.sum())} reliable tie points were found between "
            f"{', '.join(v.name for v in orientation.views)}, too few to tell the height range of the ground "
            f"({MIN_TIES_FOR_RANGE} are needed). Give --heights ZMIN ZMAX or --dem, or check that the images overlap."
        )
    low, high = np.percentile(orientation.xyz[trusted, 2], RANGE_PERCENT)
    margin = options.range_margin * (high - low)
    low, high = float(low - margin), float(high + margin)
    down, up = (
        more if station is None else min(more, MAX_MARGIN_SHARE_OF_DEPTH * max(station - z, 0.0))
        for more, z in ((options.range_down_m, low), (options.range_up_m, high))
    )
    return low - down, high + up


def supported(xyz: FloatArray, sigma_z_m: FloatArray) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """(n,) ties whose height agrees with three or more of their eight nearest neighbours.

    Two heights agree when a slope of 1.5 between them, and four sigma of both, explain their difference.
    """
    good = np.flatnonzero(np.isfinite(xyz).all(axis=1))
    trusted = np.zeros(len(xyz), bool)
    if len(good) <= MIN_AGREEING_NEIGHBOURS:
        return trusted
    distance, near = nearest_points(xyz[good, :2], min(NEIGHBOURS + 1, len(good)))
    sigma = np.hypot(sigma_z_m[good][:, None], sigma_z_m[good][near[:, 1:]])
    difference = np.abs(xyz[good, 2][:, None] - xyz[good, 2][near[:, 1:]])
    agrees = difference <= MAX_SLOPE * distance[:, 1:] + MAX_HEIGHT_SIGMAS * sigma
    trusted[good] = agrees.sum(axis=1) >= MIN_AGREEING_NEIGHBOURS
    return trusted


def nearest_points(xy: FloatArray, count: int) -> tuple[FloatArray, NDArray[np.int32]]:
    """Distances (n, k) and numbers (n, k) of the `count` points nearest to each of xy (n, 2), itself among them."""
    points = (xy - xy.mean(axis=0)).astype(np.float32)
    index = cv2.flann.Index(points, {"algorithm": KD_TREE, "leaf_max_size": 10})
    near, squared = index.knnSearch(points, count, params={"checks": -1, "eps": 0.0, "sorted": True})
    return np.sqrt(squared.astype(float)), near
