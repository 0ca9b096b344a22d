"""Findings about footprints, overlaps and base-to-height ratios, and about cameras that contradict themselves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from zlocus.core.footprints import PairGeometry, ViewGeometry
from zlocus.core.scene import View
from zlocus.pipeline.doctor.findings import NOTE, POOR, Finding, poor

# Limits beyond which a finding is made.
CLOSING_PX = 0.05
NARROW, WIDE = 0.1, 1.2
PIXEL_SHARE = 0.2  # by which an ordinary match is off
FINER = 3.0
SHADOWS_DEG = 20.0


def geometry_findings(
    names: Sequence[str], views: Sequence[ViewGeometry], pairs: Sequence[PairGeometry]
) -> list[Finding]:
    """Findings about cameras, overlaps and base-to-height ratios."""
    told = []
    for name, view in zip(names, views, strict=True):
        if view.lost > 0:
            lost = f"its camera cannot map {100 * view.lost:.0f} % of its pixels to the ground."
            told.append(poor(name, f"{lost} Check the camera and the heights."))
        if view.closing_px > CLOSING_PX:
            off = f"pixels sent to the ground and back miss themselves by up to {view.closing_px:.2f} px"
            told.append(poor(name, f"{off}, so its camera does not agree with itself. Check its file."))
    pixels = np.array([view.ground_px_m for view in views])
    if np.nanmax(pixels) > FINER * np.nanmin(pixels):
        coarse, fine = names[int(np.nanargmax(pixels))], names[int(np.nanargmin(pixels))]
        told.append(
            Finding(
                POOR,
                f"{coarse} has pixels of {np.nanmax(pixels):.2g} m on the ground and {fine} of {np.nanmin(pixels):.2g} "
                "m: images so different are hard to match. Leave the coarser ones out, or resample the finer ones.",
                (coarse, fine),
            )
        )
    return told + base_findings(names, views, pairs)


def shadow_findings(views: Sequence[View]) -> list[Finding]:
    """A finding about the two images whose suns are farthest apart, where shadows lie elsewhere in them."""
    apart = [
        (a.sun_direction.angle_deg(b.sun_direction), a.name, b.name)
        for a, b in combinations(views, 2)
        if a.sun_direction and b.sun_direction
    ]
    angle_deg, *names = max(apart, default=(0.0, "", ""))
    if angle_deg <= SHADOWS_DEG:
        return []
    sentence = (
        f"The sun stood up to {angle_deg:.0f} degrees apart ({names[0]} and {names[1]}): shadows lie elsewhere, and "
        "count for little where they differ. Images of one hour and season match better."
    )
    return [Finding(NOTE, sentence, tuple(names))]


def base_findings(names: Sequence[str], views: Sequence[ViewGeometry], pairs: Sequence[PairGeometry]) -> list[Finding]:
    """Findings about the precision that the viewing directions allow."""
    known = [pair for pair in pairs if math.isfinite(pair.base_to_height)]
    if not known:
        return []
    widest, narrowest = (f(known, key=lambda pair: pair.base_to_height) for f in (max, min))
    if widest.base_to_height < NARROW:
        a, b = (names[i] for i in widest.views)
        pixel = max(views[i].ground_px_m for i in widest.views)
        height = PIXEL_SHARE * pixel / max(widest.base_to_height, 1e-9)
        return [
            Finding(
                POOR,
                f"All images look along nearly the same line: the widest pair, {a} and {b}, has a base-to-height of "
                f"{widest.base_to_height:.2g}. A match off by {PIXEL_SHARE:g} px makes a height off by {height:.2g} m. "
                "Add an image from another direction.",
                (a, b),
            )
        ]
    if narrowest.base_to_height > WIDE:
        a, b = (names[i] for i in narrowest.views)
        return [
            Finding(
                POOR,
                f"Even the narrowest pair, {a} and {b}, has a base-to-height of {narrowest.base_to_height:.2g}: seen "
                "from so far apart, things look too different to match well. Add images from between.",
                (a, b),
            )
        ]
    return []
