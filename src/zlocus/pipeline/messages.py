"""What commands say of orientation, cameras and terrain models: notes on the way, and the last refusal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from zlocus.core.progress import Progress
from zlocus.core.quoting import first_names
from zlocus.io.grid_inputs import lacks_vertical_datum
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.plausibility import Doubt

# A message names at most this many images or doubts.
MAX_NAMED = 12
# A height takes at least this many images.
MIN_VIEWS = 2


def some_names(names: Sequence[str]) -> str:
    """The first names, separated by commas, and how many more there are."""
    return first_names(names, MAX_NAMED)


def note_dem(dem: Path | None, dem_vertical: str | None, progress: Progress, option: str = "--dem-vertical") -> None:
    """Say which vertical datum is assumed for a DEM where neither the request nor its file names one. option : that
    would name it."""
    if dem is not None and dem_vertical is None and lacks_vertical_datum(dem):
        progress.note(
            f"{dem} does not name its vertical datum: its heights are taken to be ellipsoidal. Where they are above a "
            f"geoid, as those of most terrain models, give it with {option} egm96|egm2008|FILE."
        )


def note_orientation(orientation: Orientation, progress: Progress, has_heights: bool = False) -> None:
    """Say which corrections were applied, which parameters of the cameras were calibrated or held, which images take no
    part, and which cameras are doubtful.

    has_heights : whether heights were asked for, and images are matched next. Where fewer than two then have ties, the
    heights may be the reason, and nothing is said here: see `setup.set_up_run`.
    """
    if has_heights and len(orientation.views) - len(orientation.excluded_images) < MIN_VIEWS:
        return
    progress.note(what_was_applied(orientation))
    for sentence in self_calibration_sentences(orientation):
        progress.note(sentence)
    note_excluded(orientation, progress)
    note_doubts(orientation.doubts, progress)


def note_excluded(orientation: Orientation, progress: Progress) -> None:
    """Say which images take no part in the matching, and why."""
    for excluded in orientation.excluded_images[:MAX_NAMED]:
        progress.note(str(excluded))
    if len(orientation.excluded_images) > MAX_NAMED:
        progress.note(f"{len(orientation.excluded_images) - MAX_NAMED} more images take no part: see run.json.")


def self_calibration_sentences(orientation: Orientation) -> list[str]:
    """What a self-calibration corrected, for each camera in one sentence, and why it held the other parameters."""
    bundle_adjustment = orientation.bundle_adjustment
    if bundle_adjustment is None:
        return []
    from zlocus.orientation.determinability import images_in_words

    names = [view.name for view in orientation.views]
    corrections: dict[tuple[int, ...], list[str]] = {}
    for each in bundle_adjustment.calibration:
        if not each.is_held:
            text = f"{each.words} {each.value:+.4g}{each.unit} (standard deviation {each.sigma:.2g}{each.unit})"
            corrections.setdefault(each.views, []).append(text)
    found = [
        f"Self-calibration of {images_in_words(views, names)}: {', '.join(texts)}."
        for views, texts in corrections.items()
    ]
    return [*found, *(held.sentence(names) for held in bundle_adjustment.solution.held_parameters)]


def note_doubts(doubts: Sequence[Doubt], progress: Progress) -> None:
    """Say which doubts there are about the cameras."""
    for doubt in doubts[:MAX_NAMED]:
        progress.note(doubt.sentence)
    if len(doubts) > MAX_NAMED:
        progress.note(f"There are {len(doubts) - MAX_NAMED} more doubts about the cameras: see run.json.")


def grave_doubt(doubts: Sequence[Doubt], product: Path) -> str:
    """Why the heights of a run are likely to be wrong: the first of the grave doubts; "" where there is none.

    product : file that was written all the same.
    """
    grave = [doubt for doubt in doubts if doubt.is_grave]
    if not grave:
        return ""
    return f"The heights in {product} are likely to be wrong. {grave[0].sentence} Accept them with --partial."


def what_was_applied(orientation: Orientation) -> str:
    """The corrections of the cameras, in one sentence."""
    moved = [v for v in orientation.views if v.shift_px != (0.0, 0.0)]
    if orientation.bundle_adjustment is not None and orientation.bundle_adjustment.solution.is_held.all():
        return (
            f"Cameras left as delivered: {len(orientation.refined_xyz)} tie points show no errors beyond their noise, "
            f"{orientation.bundle_adjustment.solution.sigma0_px:.2f} px."
        )
    if orientation.model == "none":
        return "Cameras used as delivered: no correction was asked for."
    if not moved:
        return "Pointing not corrected: tie points show no errors, or there are none."
    if len(moved) <= MAX_NAMED:
        named = ", ".join(f"{v.name} ({v.shift_px[0]:+.2f}, {v.shift_px[1]:+.2f})" for v in moved)
        by = f"px (column, row): {named}."
    else:
        farthest = max(moved, key=lambda v: math.hypot(*v.shift_px))
        by = f"up to {math.hypot(*farthest.shift_px):.2f} px ({farthest.name})."
    if orientation.bundle_adjustment is not None:
        return (
            f"Cameras corrected by a bundle adjustment of {len(orientation.refined_xyz)} tie points, to "
            f"{orientation.bundle_adjustment.solution.sigma0_px:.2f} px; their images moved by, {by}"
        )
    n_rough = len(orientation.xyz) - orientation.n_refined
    rough = f" ({n_rough} more, less exact ones, tell heights only)" if n_rough else ""
    return f"Pointing corrected from {orientation.n_refined} tie points{rough}, {by}"
