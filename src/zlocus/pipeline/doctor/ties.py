"""A quick search for tie points, with fewer features than in a run and the same adjustment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from zlocus.core.errors import GeometryError
from zlocus.core.footprints import PairGeometry
from zlocus.core.height_range import HeightRange
from zlocus.core.options import OrientationOptions, RunConfig
from zlocus.core.progress import Progress
from zlocus.core.scene import Scene, held_window
from zlocus.orientation.orientation import Orientation
from zlocus.pipeline.doctor.findings import POOR, STOPS, Finding, poor
from zlocus.pipeline.height_range import range_below_cameras, range_from_ties
from zlocus.pipeline.messages import MIN_VIEWS
from zlocus.pipeline.setup import orient_views

QUICK_FEATURES = 4000
# Images above this size are reduced twice as much as in a run.
LARGE_MPX, LARGE_DETAIL = 4.0, 1.0 / 16.0
# Limits beyond which a finding is made.
EXPECTED_OVERLAP = 0.2
FEW_TIES = 30
NEAR_LIMIT = 0.7


@dataclass(frozen=True)
class QuickTies:
    """Result of the quick search.

    orientation : as in a run; height_range : heights that a run would search; is_quick : whether fewer features were
    used than in a run.
    """

    orientation: Orientation
    height_range: HeightRange
    is_quick: bool


def quick_options(options: OrientationOptions, scene: Scene) -> OrientationOptions:
    """The options with fewer features, and with large images reduced more."""
    largest = max(math.prod(held_window(view.image)[2:]) for view in scene.views) / 1e6
    detail = options.full_detail_mpx * (LARGE_DETAIL if largest > LARGE_MPX else 1.0)
    return replace(
        options,
        features_per_image=min(options.features_per_image, QUICK_FEATURES),
        full_detail_mpx=max(detail, 1e-3),
    )


def quick_ties(scene: Scene, config: RunConfig, asked: tuple[float, float] | None, progress: Progress) -> QuickTies:
    """Tie points, and the heights that a run would search. All features are used where a few do not tie every image.

    asked : heights (m) of the request or of the scene file.

    Raises
    ------
    GeometryError
        Where a run would find too few ties to go on.
    """
    quick = quick_options(config.orientation, scene)
    if quick != config.orientation:
        try:
            found = _ties(scene, quick, asked, progress, is_quick=True)
        except GeometryError:
            pass
        else:
            if all(view.n_ties for view in found.orientation.views):
                return found
    return _ties(scene, config.orientation, asked, progress, is_quick=False)


def _ties(
    scene: Scene,
    options: OrientationOptions,
    asked: tuple[float, float] | None,
    progress: Progress,
    is_quick: bool,
) -> QuickTies:
    orientation = orient_views(replace(scene, heights=asked), options, progress)
    corrected = orientation.apply(scene)
    height_range = (
        range_from_ties(corrected, orientation, options)
        if asked is None
        else HeightRange.limited_to(range_below_cameras(scene, asked, progress))
    )
    return QuickTies(orientation, height_range, is_quick)


def tie_findings(
    names: Sequence[str], orientation: Orientation, pairs: Sequence[PairGeometry], options: OrientationOptions
) -> list[Finding]:
    """Findings about the tie points."""
    findings = []
    excluded = {each.name: each.reason for each in orientation.excluded_images}
    for view in orientation.views:
        moved = max(map(abs, view.shift_px))
        if view.name in excluded:
            sentence = f"it takes no part: {excluded[view.name]}"
        elif view.n_ties < FEW_TIES:
            sentence = f"only {view.n_ties} tie points hold its camera. Its correction may be off."
        elif NEAR_LIMIT * options.max_pointing_px < moved <= options.max_pointing_px:
            sentence = (
                f"its camera is off by {moved:.0f} px, close to the {options.max_pointing_px:g} px within which ties "
                "are looked for. Set a larger orientation.max_pointing_px in --config."
            )
        else:
            continue
        findings.append(poor(view.name, sentence))
    if len(orientation.views) - len(excluded) < MIN_VIEWS:
        findings.append(Finding(STOPS, "No two images are held together by tie points: a run will match nothing."))
    findings += [Finding(STOPS if doubt.is_grave else POOR, doubt.sentence) for doubt in orientation.doubts]
    tied = {frozenset(pair.views) for pair in orientation.pairs}
    for pair in pairs:
        a, b = (names[i] for i in pair.views)
        if pair.overlap > EXPECTED_OVERLAP and frozenset((a, b)) not in tied and not {a, b} & excluded.keys():
            findings.append(
                Finding(
                    POOR,
                    f"{a} and {b} share {100 * pair.overlap:.0f} % of their ground, but no tie point was found in "
                    "both: they look too different (season, light, direction) to be matched well.",
                    (a, b),
                )
            )
    return findings
