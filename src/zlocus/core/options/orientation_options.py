"""Options of tie points and of the correction of cameras."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.errors import ConfigError
from zlocus.core.options.option_fields import Checked, group, option

# Parameters of a self-calibration, in the order in which they are reported.
ALL_PARAMETERS = ("focal", "principal_point", "k1", "k2", "k3", "p1", "p2", "readout")


@dataclass(frozen=True)
class BundleAdjustmentOptions(Checked):
    """The bundle adjustment: which parameters of the cameras are corrected, and the standard deviations of the
    corrections, which say how far a camera may move from where it was delivered."""

    rpc_correction: str = option(
        "shift", "Correction of an RPC in its image: a shift, or an affine map.", choices=("shift", "affine")
    )
    sigma_affine_px: float = option(
        1.0, "Standard deviation of each affine term, as the movement of the image's edge.", low=1e-4, high=1000.0,
        unit="px",
    )  # fmt: skip
    sigma_position_m: float = option(
        0.3, "Standard deviation of the position of a frame camera or line scanner, along each axis.", low=1e-4,
        high=1e5, unit="m",
    )  # fmt: skip
    sigma_attitude_deg: float = option(
        0.01, "Standard deviation of the attitude of a frame camera or line scanner, about each axis.", low=1e-7,
        high=45.0, unit="degrees",
    )  # fmt: skip
    self_calibration: tuple[str, ...] = option(
        (), "Parameters of frame cameras that are corrected, each shared by the images of a camera (of equal interior "
        "orientation). Those that the block does not determine are held. Empty: none.",
        choices=("all", *ALL_PARAMETERS),
    )  # fmt: skip
    sigma_focal_px: float | None = option(
        None, "Standard deviation of the focal length in a self-calibration. Unset: `sigma_focal_share`.", low=1e-3,
        high=1e5, unit="px",
    )  # fmt: skip
    sigma_focal_share: float = option(
        0.01, "Standard deviation of the focal length in a self-calibration, as a share of it.", low=1e-6, high=1.0
    )
    sigma_principal_point_px: float = option(
        10.0, "Standard deviation of each coordinate of the principal point in a self-calibration.", low=1e-3, high=1e5,
        unit="px",
    )  # fmt: skip
    sigma_distortion_px: float = option(
        10.0, "Standard deviation of each coefficient of the distortion in a self-calibration, as the movement of the "
        "farthest corner of the image.", low=1e-3, high=1e5, unit="px",
    )  # fmt: skip
    sigma_readout_ms: float = option(
        10.0, "Standard deviation of the read-out time of a rolling shutter in a self-calibration.", low=1e-3, high=1e3,
        unit="ms",
    )  # fmt: skip
    drift_knot_interval_s: float = option(
        10.0, "Time between two knots of the spline that corrects a trajectory.", low=1e-3, high=1e5, unit="s"
    )
    sigma_control_m: float = option(
        0.05, "Standard deviation of ground control points whose file gives none.", low=1e-4, high=1e4, unit="m"
    )
    sigma_control_px: float = option(
        0.5, "Standard deviation of the image coordinates of ground control points.", low=1e-3, high=100.0, unit="px"
    )
    sigma_dem_m: float = option(
        5.0, "Standard deviation of the heights of a DEM given as height control.", low=1e-3, high=1e4, unit="m"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sigma_focal_px is not None and not {"all", "focal"} & set(self.self_calibration):
            raise ConfigError(
                f"BundleAdjustmentOptions.sigma_focal_px = {self.sigma_focal_px!r} has no effect, because the focal "
                'length is not corrected. Add "focal" to self_calibration, or leave sigma_focal_px out.'
            )


@dataclass(frozen=True)
class OrientationOptions(Checked):
    """Tie points and the correction of the images' orientation (method section 1)."""

    model: str = option(
        "auto", "Correction of the cameras. shift: one shift of each image; joint: a bundle adjustment of all cameras "
        "(see `bundle_adjustment`); none: no correction; auto: shift where all images have RPCs, none in a local "
        "frame, else joint.", choices=("auto", "shift", "joint", "none"),
    )  # fmt: skip
    features_per_mpx: int = option(
        3000, "SIFT features kept of an image of one megapixel, the strongest of each part. An image of four times as "
        "many pixels keeps twice as many.", low=100, high=100000,
    )  # fmt: skip
    features_per_image: int = option(30000, "Largest number of SIFT features kept per image.", low=100, high=10000000)
    full_detail_mpx: float = option(
        0.6, "Largest image in which SIFT uses all pixels. Larger ones are halved, and reduced further by the fourth "
        "root of their size above this, so that the work grows with the square root of the number of pixels.",
        low=1e-3, high=1e6, unit="Mpx",
    )  # fmt: skip
    min_ncc: float = option(
        0.7, "Smallest correlation of a refined patch: observations below it are not used to correct the cameras.",
        low=0.0, high=1.0,
    )  # fmt: skip
    max_pointing_px: float = option(
        30.0, "Largest pointing error within which ties are searched.", low=1.0, high=1000.0, unit="px"
    )
    inlier_px: float = option(
        1.0, "Largest distance of a correct tie from its epipolar curve.", low=0.1, high=10.0, unit="px"
    )
    min_ties: int = option(12, "Smallest number of ties of a pair: pairs with fewer are not used.", low=4, high=10000)
    sigma_shift_px: float = option(
        20.0, "Standard deviation of every image's shift before the adjustment. This weak prior fixes the datum.",
        low=0.1, high=1000.0, unit="px",
    )  # fmt: skip
    line_shifts: bool = option(
        True, "Estimate from the ties how lines of satellite images are displaced in slow waves, and put them right."
    )
    range_margin: float = option(
        0.2, "Height range from ties: margin added at both ends, as a share of the range of the ties' heights.",
        low=0.0, high=10.0,
    )  # fmt: skip
    range_up_m: float = option(
        8.0, "Height range from ties: margin added above, for roofs and trees without ties.", low=0.0, high=2000.0,
        unit="m",
    )  # fmt: skip
    range_down_m: float = option(
        2.0, "Height range from ties: margin added below, for streets without ties.", low=0.0, high=2000.0, unit="m",
    )  # fmt: skip
    search_up_m: float = option(
        130.0, "Heights above the range from ties at which a surface is found only where the images clearly agree.",
        low=0.0, high=2000.0, unit="m",
    )  # fmt: skip
    search_down_m: float = option(
        18.0, "Heights below the range from ties at which a surface is found only where the images clearly agree.",
        low=0.0, high=2000.0, unit="m",
    )  # fmt: skip
    bundle_adjustment: BundleAdjustmentOptions = group(
        BundleAdjustmentOptions, "Bundle adjustment of all cameras (`model` joint)."
    )
