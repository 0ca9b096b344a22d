"""Texts of the report: reasons, stages, numbers with units, and the summary."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from pyproj import CRS, Transformer

from zlocus.core.scene import is_local
from zlocus.matching.quality import EMPTY, Quality
from zlocus.matching.quality import MEANINGS as MEANINGS  # one of the texts of the report, too
from zlocus.products.report.sampling import Survey

if TYPE_CHECKING:
    from zlocus.evaluation.evaluate import Evaluation
    from zlocus.evaluation.statistics import ErrorStatistics

MASKED_MEANING = "masks leave fewer than two images"
# Why a cell has no height although its own match curve may have a high peak: see `zlocus.matching.height_checks`.
DESPITE_PEAK = {
    Quality.NO_MATCH: "the semi-global constraint puts the surface at a height that agrees with its neighbours, which "
    "need not be that of the peak. At that height, in windows that follow the slope, the mean correlation of all pairs "
    "of images that see the cell, or of the cells around it, is below {min_ncc:g} (checks.min_ncc)",
    Quality.RANGE_END: "the height that agrees best with the neighbours is the lowest or the highest candidate height "
    "({low:.1f} to {high:.1f} m)",
    Quality.OCCLUDED: "match curves do not include occlusions. At the height of the surface fewer than two images see "
    "the cell",
    Quality.INCONSISTENT: "the curve belongs to one reference image, and no other image found the same height",
    Quality.IMPRECISE: "the peak is high but wide or ambiguous: its standard deviation is larger than "
    "checks.max_sigma_m or, where that is not set, than 40 sides of a cell",
}
HIGH_PEAK = 0.5
# What the user can do about a flag, where something helps.
ADVICE = {
    Quality.UNSEEN: "add images, or choose a smaller area; with IMAGE_EXCLUDED, a mask left too few of them",
    Quality.OCCLUDED: "add images from other directions",
    Quality.RANGE_END: "give a wider --heights",
    Quality.NO_MATCH: "usual on water, snow and other ground without texture; --fill interpolate closes small gaps",
    Quality.IMPRECISE: "add images at wider angles, or allow more in checks.max_sigma_m",
    Quality.WEAK: "usual on vegetation, water and snow; check before use",
    Quality.AMBIGUOUS: "usual on repeating patterns and ground without texture; check before use",
    Quality.DISPUTED: "most gross errors in towns carry this flag; check before use",
    Quality.IMAGE_EXCLUDED: "look at its mask; without one, give --heights closer to those of the ground",
}
STAGES = {
    "open": "opening images and cameras",
    "orient": "finding tie points and correcting the cameras",
    "setup": "choosing the height range, grid and tiles",
    "match": "matching, and in one process writing the tiles",
    "points": "writing tie points and ranking",
    "curves": "footprints and match curves for this page",
    "record": "checksums of the inputs",
    "write": "joining the tiles to rasters",
    "products": "hillshade and other products of the surface",
}
SIDES = ("top", "upper right", "right", "lower right", "bottom", "lower left", "left", "upper left")
NONE = "–"
MIN_SHOWN_SHARE = 0.0001
# The summary names at most this many water surfaces.
MAX_NAMED_WATER = 5
# And at most this many parts that were redone, the last ones.
MAX_NAMED_PARTS = 3


@dataclass(frozen=True)
class Reason:
    """A row of the table of reasons.

    value : of the flag in quality.tif; fate : whether such cells have a height; share : of the requested cells.
    """

    name: str
    value: int
    meaning: str
    fate: str
    advice: str
    n: int
    share: str


def reasons(survey: Survey) -> list[Reason]:
    """Reasons that occur: first those without a height, and the most common ones first."""
    rows = []
    for flag in (*Quality, Quality.WATER):
        n = survey.count(flag)
        if n:
            base = math.prod(survey.shape) if flag is Quality.OUTSIDE else survey.n_requested
            name, advice = str(flag.name), ADVICE.get(flag, "")
            row = Reason(name, int(flag), MEANINGS[flag], fate(flag), advice, n, percent(n, base))
            rows.append((flag not in EMPTY, -n, row))
    return [row for _, _, row in sorted(rows, key=lambda each: each[:2])]


def masks(shares: Mapping[str, float]) -> str:
    """How much of each image its mask covers, as a sentence; "" without masks. shares : by the name of the view."""
    parts = listed([f"{percent(share, 1.0)} of {name}" for name, share in shares.items()])
    return f"Masks cover {parts}." if shares else ""


def fate(flag: Quality) -> str:
    """Whether cells with a flag have a height: `none`, `filled`, `levelled`, `kept`, or `either`."""
    if flag in EMPTY:
        return "none"
    if flag is Quality.IMAGE_EXCLUDED:
        return "either"
    if flag is Quality.WATER:
        return "levelled"
    return "filled" if flag is Quality.FILLED else "kept"


def percent(n: float, total: float) -> str:
    """A share in percent. A share above 0 is never written as 0, and one below 1 never as 100."""
    if not total:
        return NONE
    share = n / total
    if 0 < share < MIN_SHOWN_SHARE:
        return "< 0.01 %"
    if 1 - MIN_SHOWN_SHARE < share < 1:
        return "> 99.99 %"
    return f"{100 * share:.{2 if share < 0.1 or 0.999 <= share < 1 else 1}f} %"


def whole_percent(n: int, total: int) -> str:
    """A share in whole percent, without the sign; 0 and 100 stand for none and all only."""
    if n in (0, total):
        return "100" if n else "0"
    return str(min(max(round(100 * n / total), 1), 99))


def number(value: float | None, unit: str = "", digits: int = 2) -> str:
    """A number with a fixed number of decimals, and its unit."""
    return NONE if value is None or not math.isfinite(value) else f"{value:.{digits}f} {unit}".rstrip()


def size(value: float | None, unit: str = "") -> str:
    """A positive number with two significant digits and its unit: 0.083 m, 0.31 m, 12 m."""
    if value is None or not math.isfinite(value):
        return NONE
    decimals = 0 if value == 0 else max(1 - math.floor(math.log10(abs(value))), 0)
    return f"{value:.{decimals}f} {unit}".rstrip()


def seconds(value: float) -> str:
    """A time: 0.03 s, 12.4 s, 3 min 20 s, 2 h 10 min."""
    if value < 59.95:
        return f"{value:.2f} s" if value < 1 else f"{value:.1f} s"
    minutes, rest = divmod(round(value), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def when(created: str | None) -> str:
    """A time of run.json, to the minute; "" where there is none."""
    if not created:
        return ""
    return datetime.fromisoformat(created).astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")


def sun(azimuth_deg: float, altitude_deg: float) -> str:
    """Direction of the light on a map whose top is north, in words."""
    side = SIDES[round(azimuth_deg / 45) % len(SIDES)]
    return f"lit from the {side} (azimuth {azimuth_deg:g} degrees), {altitude_deg:g} degrees above the horizon"


def corners(survey: Survey, is_local: bool) -> list[str]:
    """Coordinates of a map's corners: upper left, upper right, lower left, lower right."""
    (rows, cols), names = survey.shape, ("x", "y") if is_local else ("E", "N")
    return [
        ", ".join(f"{name} {value:.1f}" for name, value in zip(names, survey.transform * corner, strict=True))
        for corner in ((0, 0), (cols, 0), (0, rows), (cols, rows))
    ]


def despite_peak(flag: Quality, rho1: float | None, run: Mapping[str, Any], undulation_m: float = 0.0) -> str:
    """Why a cell is empty although its mean curve has a high peak, as a sentence; "" where the peak is not high.

    undulation_m : height of the surface's vertical datum above the ellipsoid at the cell.
    """
    if rho1 is None or rho1 < HIGH_PEAK or flag not in DESPITE_PEAK:
        return ""
    low, high = (z - undulation_m for z in run["heights"]["searched_m"])
    text = DESPITE_PEAK[flag].format(min_ncc=run["config"]["options"]["checks"]["min_ncc"], low=low, high=high)
    return f"No height in spite of the peak: {text}."


def place(survey: Survey, crs: CRS) -> tuple[str, str]:
    """Position of the surface's centre, and the name of its map, in words."""
    x, y = survey.transform * (survey.shape[1] / 2, survey.shape[0] / 2)
    if is_local(crs):
        return f"around x {x:.1f} m, y {y:.1f} m of a local frame, which has no place on the Earth", "local frame"
    code = ":".join(authority) if (authority := crs.to_authority()) else "no code"
    lon, lat = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(x, y)
    where = f"around {abs(lat):.4f}° {'N' if lat >= 0 else 'S'}, {abs(lon):.4f}° {'E' if lon >= 0 else 'W'}"
    return where, f"{crs.name}, {code}"


def crs_name(text: str) -> str:
    """Name and code of the CRS of run.json, in words."""
    crs = CRS.from_user_input(text)
    if is_local(crs):
        return "local frame"
    authority = crs.to_authority()
    return f"{crs.name}, {':'.join(authority)}" if authority else crs.name


def summary(survey: Survey, run: dict[str, Any], crs: CRS, quantiles: dict[int, float]) -> str:
    """Summary of the run in one paragraph. quantiles : of the standard deviations, m, by percent."""
    rows, cols = survey.shape
    where, frame = place(survey, crs)
    views = run["orientation"]["views"]
    wide, high = cols * survey.cell_m, rows * survey.cell_m
    what = "This is a digital surface model: the height of the topmost surface, roofs and treetops included."
    if is_local(crs):
        what = "This is a surface model: the position of what the images show along z."
    said = [
        f"{what} It covers {wide:.0f} m by {high:.0f} m {where} (map: {frame}), with a cell every "
        f"{survey.cell_m:g} m, and was made from {len(views)} images.",
        f"Of the cells that two images or more cover, {percent(survey.n_matched, survey.n_covered)} have a height.",
    ]
    if survey.n_heights:
        said.append(f"Heights run from {survey.lowest_m:.1f} to {survey.highest_m:.1f} m ({survey.height_name}).")
    if 50 in quantiles:
        said.append(
            f"By the run's own estimate, which does not include errors that all images share, the standard deviation "
            f"of a height is {size(quantiles[50], 'm')} or better for half of the cells, and "
            f"{size(quantiles[90], 'm')} or better for nine in ten."
        )
    said += [what_is_missing(survey), what_is_doubtful(survey), what_is_water(run), what_was_redone(run)]
    return " ".join(sentence for sentence in said if sentence)


def what_is_missing(survey: Survey) -> str:
    """Share of cells without a height and the main reasons, in a sentence."""
    n_missing = survey.n_requested - survey.n_heights
    if n_missing <= 0:
        return "Every cell of the area has a height."
    others = EMPTY & ~(Quality.OUTSIDE | Quality.UNSEEN)
    why = [
        (survey.n_masked, MASKED_MEANING),
        (survey.count(Quality.UNSEEN) - survey.n_masked, MEANINGS[Quality.UNSEEN]),
        *((survey.count(flag), MEANINGS[flag]) for flag in others),
    ]
    common = sorted((each for each in why if each[0] > 0), key=lambda each: -each[0])[:2]
    reasons = "; ".join(f"{meaning} ({percent(n, survey.n_requested)})" for n, meaning in common)
    said = f"{percent(n_missing, survey.n_requested)} of the requested cells have no height, mostly because: {reasons}."
    return f"{said} A cell may have both reasons." if len(common) > 1 else said


def what_is_water(run: Mapping[str, Any]) -> str:
    """Levels of the water surfaces, whether more water is possible, and what is doubtful, in sentences; "" without."""
    water = run.get("water", {})
    levelled, n_possible, said = water.get("levelled", []), water.get("possible", 0), []
    if levelled:
        levels = [f"{each['name']} at {number(each['level_m'], 'm')}" for each in levelled[:MAX_NAMED_WATER]]
        more = f" and {len(levelled) - MAX_NAMED_WATER} more" if len(levelled) > MAX_NAMED_WATER else ""
        one = "surface has one level" if len(levelled) == 1 else "surfaces have one level each"
        said.append(f"{len(levelled)} water {one}, not matched heights: {listed(levels)}{more}.")
    n_kept = n_possible - sum(each["kind"] != "levelled" for each in levelled)
    if n_kept > 0:
        areas = "1 area" if n_kept == 1 else f"{n_kept} areas"
        said.append(f"Water is possible in {areas} (3 in water.tif), where the images agree at no height.")
    return " ".join([*said, *water.get("doubts", [])])


def what_was_redone(run: Mapping[str, Any]) -> str:
    """How many parts were redone after the run, and how many cells changed, in a sentence; "" without any."""
    redone = run.get("redone", [])
    if not redone:
        return ""
    parts = "1 part was" if len(redone) == 1 else f"{len(redone)} parts were"
    counts = listed(
        [f"{each['cells_changed']} cells on {str(each['time'])[:10]}" for each in redone[-MAX_NAMED_PARTS:]]
    )
    return (
        f"{parts} redone after the run ({counts}): times and options on this page are those of the run; see run.json."
    )


def what_is_doubtful(survey: Survey) -> str:
    """Shares of cells with each warning, in a sentence."""
    warnings = Quality.WEAK | Quality.AMBIGUOUS | Quality.DISPUTED | Quality.UNREFINED
    counts = sorted(((survey.count(flag), str(flag.name)) for flag in warnings), key=lambda each: -each[0])
    warned = [f"{name} ({percent(n, survey.n_requested)} of the requested cells)" for n, name in counts if n]
    return f"Heights to check before use carry a warning, explained below: {listed(warned)}." if warned else ""


def against_reference(evaluation: Evaluation, reference: str) -> str:
    """Result of the comparison with a reference, in sentences: as the surface lies, and after its shift is removed."""
    absolute = evaluation.absolute_accuracy.statistics
    return (
        f"Comparison with the reference {reference}: {percent(absolute.completeness, 1)} of its cells have a height. "
        f"As the surface lies (absolute), {_errors(absolute, evaluation.threshold_m)}. {_aligned(evaluation)}"
    )


def _aligned(evaluation: Evaluation) -> str:
    """The aligned figures, with the shift that was removed, in a sentence; or why there are none."""
    from zlocus.evaluation.table import shift_text

    shift, aligned = evaluation.found_shift, evaluation.aligned_accuracy
    if shift is None or aligned is None:
        return f"There are no aligned figures, because {evaluation.no_shift}."
    if shift.undetermined is not None:
        removed = f"the difference in height of {number(shift.up_m, 'm', 3)}"
        after = f" The horizontal shift is not determined: {shift.undetermined}."
    else:
        removed, after = f"the shift of {shift_text(shift)}", ""
    return f"After {removed} is removed (aligned), {_errors(aligned.statistics, evaluation.threshold_m)}.{after}"


def _errors(statistics: ErrorStatistics, threshold_m: float) -> str:
    return (
        f"{percent(statistics.within, 1)} have one with an error below {threshold_m:g} m, the median of the errors is "
        f"{number(statistics.median, 'm', 3)}, and their spread (NMAD) is {number(statistics.nmad, 'm', 3)}"
    )


def listed(names: Sequence[str]) -> str:
    """Names separated by commas; `none` without any."""
    return ", ".join(names) or "none"
