"""Everything that can be tuned: one frozen class per stage, nested in `RunConfig`.

Each field carries its unit and one sentence in `metadata`; `zlocus config` writes them as a commented file, and
`__post_init__` refuses values out of range with field, value and allowed range.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

from zlocus.errors import ConfigError


def option(default: Any, doc: str, *, low: float | None = None, high: float | None = None,
           choices: tuple[Any, ...] | None = None, unit: str = "") -> Any:  # fmt: skip
    """A dataclass field with its sentence, unit and allowed range (inclusive)."""
    meta = {"doc": doc, "low": low, "high": high, "choices": choices, "unit": unit}
    return field(default=default, metadata=meta)


def group(factory: Callable[[], Any], doc: str) -> Any:
    """A nested stage."""
    return field(default_factory=factory, metadata={"doc": doc})


class Checked:
    """Range checks from the fields' metadata."""

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            value, meta = getattr(self, f.name), f.metadata
            if value is None or "doc" not in meta:
                continue
            low, high, choices = meta.get("low"), meta.get("high"), meta.get("choices")
            where = f"{type(self).__name__}.{f.name}"
            if choices is not None and value not in choices:
                raise ConfigError(f"{where} = {value!r} is not one of {', '.join(map(str, choices))}.")
            if (low is not None and not value >= low) or (high is not None and not value <= high):
                allowed = f"{'-inf' if low is None else low} to {'inf' if high is None else high}"
                raise ConfigError(
                    f"{where} = {value!r} is outside its range {allowed} {meta.get('unit', '')}".rstrip() + "."
                )


@dataclass(frozen=True)
class JointOptions(Checked):
    """The joint orientation of all images: what is corrected, and how far from what was delivered (standard
    deviations)."""

    rpc: str = option("shift", "Correction of an RPC in its image.", choices=("shift", "affine"))
    sigma_affine_px: float = option(
        1.0, "Of each affine term, as far as it moves the image's border.", low=1e-4, high=1000.0, unit="px"
    )
    sigma_position_m: float = option(
        0.3, "Of the position of a frame camera or line scanner, along each axis.", low=1e-4, high=1e5, unit="m"
    )
    sigma_attitude_deg: float = option(
        0.01, "Of the attitude of a frame camera or line scanner, about each axis.", low=1e-7, high=45.0,
        unit="degrees",
    )  # fmt: skip
    sigma_focal_px: float | None = option(
        None, "Of the focal length, one for all images of equal interior orientation; unset: it stays as it is.",
        low=1e-3, high=1e5, unit="px",
    )  # fmt: skip
    drift_s: float = option(
        10.0, "Time from knot to knot of the spline that corrects a trajectory.", low=1e-3, high=1e5, unit="s"
    )
    sigma_control_m: float = option(
        0.05, "Of ground control points whose file does not say.", low=1e-4, high=1e4, unit="m"
    )
    sigma_control_px: float = option(
        0.5, "Of the image coordinates of ground control points.", low=1e-3, high=100.0, unit="px"
    )
    sigma_dem_m: float = option(5.0, "Of the heights of a DEM given as height control.", low=1e-3, high=1e4, unit="m")


@dataclass(frozen=True)
class OrientationOptions(Checked):
    """Tie points and the correction of the images' orientation (method section 7)."""

    model: str = option(
        "auto", "Correction: a shift of each image, all cameras jointly (see `joint`), none; auto: a shift where all "
        "images have RPCs, none in a local frame, else jointly.", choices=("auto", "shift", "joint", "none"),
    )  # fmt: skip
    features_per_mpx: int = option(
        3000, "SIFT features kept of an image of one megapixel, the strongest of each part; four times as many pixels "
        "give twice as many.", low=100, high=100000,
    )  # fmt: skip
    features_per_image: int = option(30000, "SIFT features kept per image, at most.", low=100, high=10000000)
    full_detail_mpx: float = option(
        0.6, "Images above this size are halved for SIFT, and reduced further by the fourth root of how far above it "
        "they are: the pixels that SIFT looks at grow with the square root of the image's.",
        low=1e-3, high=1e6, unit="Mpx",
    )  # fmt: skip
    patch_px: int = option(
        9, "Side of the patch by which each tie is measured again in the images as they are.", low=5, high=51,
        unit="px",
    )  # fmt: skip
    least_ncc: float = option(
        0.7, "Correlation of such patches below which an observation says nothing of the pointing.", low=0.0, high=1.0
    )
    match_ratio: float = option(
        0.8, "Descriptor distance of a match over that of its best rival, at most.", low=0.1, high=1.0
    )
    max_pointing_px: float = option(30.0, "Largest pointing error looked for.", low=1.0, high=1000.0, unit="px")
    inlier_px: float = option(
        1.0, "Distance from the locus at which a tie still counts as right.", low=0.1, high=10.0, unit="px"
    )
    min_ties: int = option(12, "Fewest ties of a pair that are used.", low=4, high=10000)
    prior_px: float = option(
        20.0,
        "Sigma of the weak prior on every image's shift, which fixes the datum.",
        low=0.1,
        high=1000.0,
        unit="px",
    )
    range_margin: float = option(
        0.2, "Height range found from ties: added at both ends, as a share of the ties' span.", low=0.0, high=10.0
    )
    range_up_m: float = option(
        60.0,
        "Height range found from ties: added above, for towers and trees without ties.",
        low=0.0,
        high=2000.0,
        unit="m",
    )
    range_down_m: float = option(
        20.0,
        "Height range found from ties: added below, for pits and streets without ties.",
        low=0.0,
        high=2000.0,
        unit="m",
    )
    joint: JointOptions = group(JointOptions, "Joint orientation of all images.")


@dataclass(frozen=True)
class PyramidOptions(Checked):
    """Levels, tiles and the range of heights that each block of cells searches (method sections 1, 6 and 9)."""

    max_shift_px: float = option(
        0.5, "Shift per height step in the most sensitive image, at most.", low=0.05, high=2.0, unit="px"
    )
    coarsest_steps: int = option(
        128, "Levels are added until the whole height range has at most this many steps at the coarsest.",
        low=16, high=4096,
    )  # fmt: skip
    max_levels: int = option(6, "Levels of the pyramid, at most.", low=1, high=12)
    block: int = option(32, "Cells along the side of a block, which shares one range of heights.", low=8, high=128)
    tile: int = option(
        1024, "Cells along the side of a tile's core, about: up to half as many more.", low=64, high=8192
    )
    halo: int = option(32, "Cells around a tile's core at every level, matched for its sake.", low=8, high=512)
    margin_steps: int = option(
        3, "Steps added at both ends of what a coarser level found.", low=1, high=1000, unit="steps"
    )
    dem_up_m: float = option(100.0, "Searched above a DEM given as --dem.", low=0.0, high=1e4, unit="m")
    dem_down_m: float = option(50.0, "Searched below a DEM given as --dem.", low=0.0, high=1e4, unit="m")
    finest_rounds: int = option(
        1,
        "Times the finest level is matched where three views or more see a tile; the later know what hides what.",
        low=1,
        high=10,
    )
    reach: int = option(2, "Coarse cells around a block whose heights it searches too.", low=0, high=64, unit="cells")


@dataclass(frozen=True)
class MeasureOptions(Checked):
    """How views are compared (method sections 1 and 5)."""

    small_window: int = option(3, "Side of the smaller correlation window.", choices=(3, 5, 7, 9, 11), unit="cells")
    large_window: int = option(
        5, "Side of the larger correlation window, whose NCC is averaged with the smaller's.",
        choices=(3, 5, 7, 9, 11), unit="cells",
    )  # fmt: skip
    few_views: int = option(
        3, "Blocks that more images see are matched with the smaller window alone.", low=1, high=255
    )
    noise: float = option(
        0.0, "Standard deviation added to every window, as a share of the image's own: damps plain windows.",
        low=0.0, high=1.0,
    )  # fmt: skip
    grey_weight: float = option(
        1.0, "Weight of grey differences between views beside the correlation, which is blind on plain roofs.",
        low=0.0, high=1.5,
    )  # fmt: skip
    grey_weight_two: float = option(
        0.3, "The same where two of more views see a block: a pair's grey values are alike by chance at many heights.",
        low=0.0, high=1.5,
    )  # fmt: skip
    grey_reach: float = option(
        0.3, "Grey difference from which on two views are strangers, as a share of the image's deviation.",
        low=0.01, high=10.0,
    )  # fmt: skip
    hidden_excused: float = option(
        0.5, "Share of the pairs with a hidden view that is left out; the others count as uncorrelated.",
        low=0.0, high=1.0,
    )  # fmt: skip
    hidden_margin_steps: float = option(
        2.0, "A view counts as hidden this far below what hides it.", low=0.0, high=1000.0, unit="steps"
    )


@dataclass(frozen=True)
class SemiGlobalOptions(Checked):
    """Penalties of the semi-global constraint, in cost units: 64 is the cost of NCC 0 (method section 5)."""

    predecessors: int | None = option(
        None, "Neighbours that each of the eight paths draws on: 1 (semi-global) or 2 (more global, slower); unset: 1 "
        "where a height step is higher than two cells (narrow bases), else 2.", choices=(1, 2),
    )  # fmt: skip
    p1: int = option(45, "Penalty of a neighbour one step away.", low=0, high=1000)
    p1_two: int = option(
        110, "The same in scenes of two images: one pair's curves are noisy.",
        low=0, high=1000,
    )  # fmt: skip
    p2: int = option(400, "Penalty of a jump where the ortho-image is even.", low=1, high=4000)
    p2_edge: int = option(45, "Penalty of a jump across a strong edge of the ortho-image.", low=1, high=4000)
    level_easing: float = option(
        0.85, "Penalties of jumps are eased by this at every coarser level, where a roof has fewer cells.",
        low=0.1, high=1.0,
    )  # fmt: skip
    edge_contrast: float = option(
        1.0, "Grey difference that halves the penalty of a jump, in median differences of the tile.",
        low=0.01, high=1e3,
    )  # fmt: skip
    edge_contrast_two: float = option(
        4.0,
        "The same where only two views see a cell: one pair is alike by chance at many heights.",
        low=0.01,
        high=1e3,
    )


@dataclass(frozen=True)
class RefineOptions(Checked):
    """The last pass: sub-step heights from windows that follow the surface (method section 6)."""

    window: int | None = option(
        None,
        "Side of the correlation window; unset: 9 where a height step is higher than two cells (narrow bases, noise "
        "rules), else 7 (relief within the window rules).",
        choices=(3, 5, 7, 9, 11, 13),
        unit="cells",
    )
    rounds: int = option(2, "Times the surface is smoothed and measured again.", low=0, high=10)
    jump_steps: float = option(
        2.0, "Height difference that smoothing does not bridge.", low=0.5, high=100.0, unit="steps"
    )
    reach_steps: float = option(
        1.5, "A refined height stays this close to the semi-global one, else that is kept.", low=0.1, high=10.0,
        unit="steps",
    )  # fmt: skip


@dataclass(frozen=True)
class PlaneOptions(Checked):
    """Planes in place of the heights of plain segments, such as roofs without texture (method section 6)."""

    texture: float = option(
        0.4, "Grey deviation below which a cell is plain, as a share of the tile's median; 0: no planes.",
        low=0.0, high=1.0,
    )  # fmt: skip
    least_cells: int = option(60, "Cells of a plain segment, at least.", low=10, high=100000)
    most_cells: int = option(20000, "Cells of a plain segment, at most.", low=10, high=1000000)
    longest_cells: float = option(
        160.0, "Longer side of a plain segment, at most: a street follows the ground.", low=4.0, high=1e4, unit="cells"
    )
    least_filled: float = option(
        0.6, "Share of a rectangle of its extent that a plain segment fills, at least.", low=0.0, high=1.0
    )
    noise: float = option(
        0.3, "Grey difference between views that says little, as a share of the tile's median deviation.",
        low=0.01, high=10.0,
    )  # fmt: skip
    most_cost: float = option(
        0.2, "A segment is plain, and a plane right, where views differ by less than this within, in noise squared.",
        low=0.0, high=10.0,
    )  # fmt: skip
    near_steps: float = option(
        3.0, "A height confirms a plane that is nearer than this.", low=0.1, high=100.0, unit="steps"
    )
    least_near: float = option(
        0.8, "Share of the cells that confirm a plane, at least; half of them where the views agree better on it.",
        low=0.5, high=1.0,
    )  # fmt: skip
    most_slope_steps: float = option(0.8, "Slope of a plane, at most, in steps per cell.", low=0.0, high=100.0)


@dataclass(frozen=True)
class SelectionOptions(Checked):
    """Which search images a cell is matched with, in which order, and when they are enough (method sections 2 to 4)."""

    rho1_high: float = option(0.90, "Good above this largest correlation and `ratio_high`.", low=0.0, high=1.0)
    ratio_high: float = option(1.2, "Good above this ratio of peaks and `rho1_high`.", low=1.0, high=100.0)
    rho1_middle: float = option(0.80, "Good above this largest correlation and `ratio_middle`.", low=0.0, high=1.0)
    ratio_middle: float = option(1.4, "Good above this ratio of peaks and `rho1_middle`.", low=1.0, high=100.0)
    rho1_low: float = option(
        0.65, "Good above this largest correlation and `ratio_low`, fair above it at any ratio.", low=0.0, high=1.0
    )
    ratio_low: float = option(1.6, "Good above this ratio of peaks and `rho1_low`.", low=1.0, high=100.0)
    rho1_fair: float = option(0.50, "Fair above this largest correlation and `ratio_fair`.", low=0.0, high=1.0)
    ratio_fair: float = option(1.4, "Fair above this ratio of peaks and `rho1_fair`.", low=1.0, high=100.0)
    rival_px: float = option(
        2.0, "Equivalent disparity from the peak at which another maximum is a rival.", low=0.0, high=100.0, unit="px"
    )
    negative_rival: str = option(
        "absolute", "Ratio to a rival of no positive correlation: of absolute values, or infinite.",
        choices=("absolute", "infinite"),
    )  # fmt: skip
    least_seen: float = option(
        0.5, "A curve seen over a smaller share of its heights is never good.", low=0.0, high=1.0
    )
    neighbours: str = option(
        "radius", "Feature points that order the images of a cell: those within the radius, or the corners of the TIN "
        "triangle around it.", choices=("radius", "tin"),
    )  # fmt: skip
    radius_px: float = option(
        100.0, "Distance within which feature points order the images of a cell.", low=1.0, high=1e5, unit="px"
    )
    nearest: int = option(5, "Feature points taken where none is within the radius.", low=1, high=1000)
    widest: float = option(
        5.0, "Those are looked for within so many radii; beyond, the order of the whole scene holds.",
        low=1.0, high=1000.0,
    )  # fmt: skip
    accumulate: str = option(
        "sum", "What orders images: the sum of their labels, or the count of those that are good.",
        choices=("sum", "count"),
    )  # fmt: skip
    stopped_share: float = option(
        0.75, "A block adds images until this share of its sampled cells has stopped.", low=0.0, high=1.0
    )
    sigma_steps: float = option(
        0.12, "A cell stops only where its peak is predicted to this standard deviation; 1000: by its label alone.",
        low=1e-3, high=1000.0, unit="steps",
    )  # fmt: skip
    reach_steps: int = option(
        40, "Labels are judged over so many heights of the finest level to both sides.", low=4, high=1000, unit="steps"
    )
    feature_cells: int = option(
        24, "One tie point ranks the images in a square of this side.", low=1, high=1000, unit="cells"
    )
    least_worth: float = option(
        0.45, "An image is left out where its accumulated label is below this share of the best one's.",
        low=0.0, high=1.0,
    )  # fmt: skip
    order: str = option(
        "angle", "Which of the images that help comes first: that whose angle to the reference is nearest to "
        "`best_angle_deg`, or that of the highest accumulated label.", choices=("angle", "labels"),
    )  # fmt: skip
    fewest_views: int = option(7, "Where fewer images see a tile, all are used.", low=3, high=255)
    least_images: int = option(2, "Search images that are kept whatever their labels say.", low=1, high=254)
    most_images: int = option(
        5, "Search images a cell is matched with at most; the refinement takes all that help.", low=1, high=254
    )
    candidates: int = option(12, "Search images considered for a block, at most.", low=1, high=254)
    least_overlap: float = option(
        0.2, "Images that see a smaller share of a block are considered last.", low=0.0, high=1.0
    )
    least_angle_deg: float = option(
        5.0, "Images at a smaller angle to the reference are considered last.", low=0.0, high=90.0, unit="degrees"
    )
    best_angle_deg: float = option(
        20.0, "Images at about this angle to the reference are considered first.", low=0.1, high=90.0, unit="degrees"
    )
    most_angle_deg: float = option(
        45.0, "Images at a larger angle to the reference are considered last.", low=1.0, high=180.0, unit="degrees"
    )
    half_days: float = option(
        60.0, "Days between two images that halve the worth of matching them.", low=0.01, high=1e6, unit="days"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.least_angle_deg <= self.best_angle_deg <= self.most_angle_deg:
            raise ConfigError(
                f"SelectionOptions.best_angle_deg = {self.best_angle_deg!r} is outside least_angle_deg to "
                f"most_angle_deg = {self.least_angle_deg!r} to {self.most_angle_deg!r} degrees."
            )


@dataclass(frozen=True)
class CheckOptions(Checked):
    """When a cell stays empty, or is marked as doubtful."""

    least_ncc: float = option(
        -0.2, "A cell is left empty below this mean NCC: less than plain roofs give, where noise decides.",
        low=-1.0, high=1.0,
    )  # fmt: skip
    doubtful_ncc: float = option(0.3, "A cell is marked as weak below this mean NCC.", low=-1.0, high=1.0)
    disputed_steps: float = option(
        1.0, "A cell is marked as disputed where the heights of two groups of pairs of images are farther apart around "
        "it.", low=0.0, high=100.0, unit="steps",
    )  # fmt: skip
    rival_cost: int = option(
        64, "A cell is marked as ambiguous when another height costs less than this more over the eight paths.",
        low=0, high=10000,
    )  # fmt: skip
    most_spread_steps: float = option(
        8.0, "At the border of the ground that images share, a cell is left empty where the standard deviations of the "
        "heights around it (geometric mean over 5 x 5 cells) are larger than this: such heights are noise.",
        low=0.1, high=1e4, unit="steps",
    )  # fmt: skip
    most_sigma_m: float | None = option(
        None, "A cell of a surface is left empty where the standard deviation of its height is larger; unset: none is.",
        low=1e-6, high=1e5, unit="m",
    )  # fmt: skip


@dataclass(frozen=True)
class ProductOptions(Checked):
    """Maps made of a surface: hillshade, contours, terrain."""

    ortho_levels: str = option(
        "common", "Ortho-image: grey values and colours levelled to those of the leading image, without the fall-off "
        "of lenses, or as each image has them.", choices=("common", "own"),
    )  # fmt: skip
    sun_azimuth_deg: float = option(
        315.0, "Hillshade: direction of the sun, from north over east.", low=0.0, high=360.0, unit="degrees"
    )
    sun_altitude_deg: float = option(
        45.0, "Hillshade: height of the sun above the horizon.", low=0.0, high=90.0, unit="degrees"
    )
    contour_interval_m: float | None = option(
        None, "Height between contours; unset: 1, 2 or 5 times a power of ten that gives 10 to 25 of them within two "
        "standard deviations of the mean height, but at least 0.1.", low=1e-3, high=1e4, unit="m",
    )  # fmt: skip
    contours_of: str = option(
        "dsm", "What contours are drawn of: the surface, or the terrain, which then must be among the products.",
        choices=("dsm", "dtm"),
    )  # fmt: skip
    contour_least_cells: float = option(
        12.0, "Closed contours whose line is shorter than so many cells are left out; 0 keeps all.",
        low=0.0, high=1e6, unit="cells",
    )  # fmt: skip
    ground_cell_m: float = option(
        1.0, "Terrain: side of the cells in which ground is looked for, about.", low=0.01, high=1e3, unit="m"
    )
    ground_window_m: float = option(
        40.0, "Terrain: half the width of the largest building or wood that is removed.", low=0.1, high=1e4, unit="m"
    )
    ground_slope: float = option(
        0.15, "Terrain: steepest slope of the ground, as a ratio: what rises more above its surroundings is none.",
        low=0.0, high=10.0,
    )  # fmt: skip
    ground_tolerance_m: float = option(
        0.5, "Terrain: a cell is ground where its height is this close to the terrain found first.",
        low=0.0, high=100.0, unit="m",
    )  # fmt: skip
    ground_scaling: float = option(
        1.25, "Terrain: added to the tolerance, times the slope there.", low=0.0, high=100.0, unit="m"
    )


@dataclass(frozen=True)
class RunConfig(Checked):
    """A whole run."""

    orientation: OrientationOptions = group(OrientationOptions, "Tie points and pointing corrections.")
    pyramid: PyramidOptions = group(PyramidOptions, "Levels, tiles and ranges of heights.")
    measure: MeasureOptions = group(MeasureOptions, "How views are compared.")
    selection: SelectionOptions = group(SelectionOptions, "Which images a block is matched with.")
    semiglobal: SemiGlobalOptions = group(SemiGlobalOptions, "Semi-global constraint.")
    refine: RefineOptions = group(RefineOptions, "Sub-step refinement.")
    planes: PlaneOptions = group(PlaneOptions, "Planes through plain segments.")
    checks: CheckOptions = group(CheckOptions, "Empty and doubtful cells.")
    products: ProductOptions = group(ProductOptions, "Maps made of the surface.")
