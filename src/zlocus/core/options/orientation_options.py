"""Options of tie points and of the correction of cameras."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.option_fields import Checked, group, option


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
