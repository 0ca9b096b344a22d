"""`zlocus doctor`: images, overlap, tie points, geometry and plan are checked in this order.

A check that fails becomes a finding, and the other checks follow all the same.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from zlocus.core.errors import ZlocusError, ZlocusNote, ZlocusWarning
from zlocus.core.footprints import PairGeometry, ViewGeometry, check_overlap, pair_geometries, view_geometry
from zlocus.core.options import ProductOptions, RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import DoctorRequest
from zlocus.core.scene import Scene
from zlocus.io.run_record import write_record
from zlocus.io.scene_file import UsableViews, open_usable_views
from zlocus.pipeline.doctor.advice import image_advice
from zlocus.pipeline.doctor.findings import NOTE, POOR, STOPS, Finding
from zlocus.pipeline.doctor.geometry import geometry_findings, shadow_findings
from zlocus.pipeline.doctor.plan import plan_findings, run_plan
from zlocus.pipeline.doctor.plane import plane_findings
from zlocus.pipeline.doctor.quality import image_quality, quality_findings
from zlocus.pipeline.doctor.report import Diagnosis
from zlocus.pipeline.doctor.ties import QuickTies, quick_ties, tie_findings
from zlocus.pipeline.height_range import possible_heights
from zlocus.pipeline.output_folder import made_folder
from zlocus.pipeline.required_space import check_room_before_ties
from zlocus.pipeline.setup import requested_crs, sorted_views
from zlocus.products.footprints import footprints_picture, write_footprints
from zlocus.products.ortho_colours import colour_records, colour_sentence
from zlocus.products.other_styles import write_other_styles

REPORT, FOOTPRINTS, PICTURE = "doctor.json", "footprints.geojson", "footprints.png"
T = TypeVar("T")


@dataclass
class Findings:
    """The findings so far."""

    entries: list[Finding] = field(default_factory=list)

    @contextmanager
    def warned(self) -> Iterator[None]:
        """Turn the warnings inside the block into findings."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", ZlocusWarning)
            try:
                yield
            finally:
                for each in caught:
                    if issubclass(each.category, ZlocusWarning):
                        level = NOTE if issubclass(each.category, ZlocusNote) else POOR
                        self.entries.append(Finding(level, str(each.message)))

    def tried(self, step: Callable[[], T], about: tuple[str, ...] = ()) -> T | None:
        """The result of a step; None where it fails, as a run would: its message becomes a finding."""
        with self.warned():
            try:
                return step()
            except ZlocusError as error:
                self.entries.append(Finding(STOPS, str(error), about))
                return None

    def refuses(self, check: Callable[[], object]) -> bool:
        """Whether a check fails; its message becomes a finding."""
        before = len(self.entries)
        self.tried(check)
        return any(finding.level == STOPS for finding in self.entries[before:])


def run_doctor(request: DoctorRequest, config: RunConfig, progress: Progress) -> Diagnosis:
    """Check the inputs of a run, and write the findings to `request.out` where that is given.

    Raises
    ------
    InputError, ConfigError, OutputError
        Nothing can be checked, or the findings cannot be written.
    """
    findings = Findings()
    with progress.stage("Opening images"), findings.warned():
        usable = open_usable_views(request.inputs, requested_crs(request.crs))
    for reason in dict.fromkeys(each.reason for each in usable.refused):
        about = tuple(each.name for each in usable.refused if each.reason == reason)
        findings.entries.append(Finding(STOPS, reason, about))
    scene = usable.scene
    if scene is None:
        diagnosis = Diagnosis((), (), (), (), None, None, usable.refused, (), tuple(findings.entries))
    else:
        scene = sorted_views(scene)
        diagnosis = examined(request, config, scene, usable, findings, progress)
    if request.out is not None:
        write_diagnosis(request.out, diagnosis, scene, config.products)
    return diagnosis


def examined(
    request: DoctorRequest,
    config: RunConfig,
    scene: Scene,
    usable_views: UsableViews,
    findings: Findings,
    progress: Progress,
) -> Diagnosis:
    """All findings about the views that could be opened."""
    names = [view.name for view in scene.views]
    quality = []
    with progress.stage("Image quality", len(names)) as stage:
        for view in scene.views:
            quality.append(findings.tried(lambda view=view: image_quality(view.image), (view.name,)))  # type: ignore[misc]
            stage.advance()
    known = [(name, found) for name, found in zip(names, quality, strict=True) if found is not None]
    if sentence := colour_sentence(colour_records(scene.views)):
        findings.entries.append(Finding(NOTE, sentence))
    findings.entries += quality_findings([name for name, _ in known], [found for _, found in known])
    geometry: tuple[ViewGeometry, ...] = ()
    pairs: tuple[PairGeometry, ...] = ()
    ties = plan = None
    advice: list[str] = []
    if len(names) < 2:
        findings.entries.append(Finding(STOPS, f"Only {names[0]} can be used, and a surface needs two images or more."))
        levels = None
    else:
        asked = request.heights or scene.heights
        levels = findings.tried(lambda: possible_heights(scene, asked))
    if levels is not None:
        within = replace(scene, heights=asked)
        room = partial(check_room_before_ties, request.out or Path(), within, request.resolution, None, None)
        has_room = not findings.refuses(room)
        ties = found_ties(scene, levels, config, asked, findings, progress) if all(quality) and has_room else None
        corrected = scene if ties is None else ties.orientation.apply(scene)
        z = ground_height(ties, levels)
        geometry = tuple(view_geometry(view, z) for view in corrected.views)
        pairs = tuple(pair_geometries(corrected.views, [each.outline for each in geometry], z))
        findings.entries += geometry_findings(names, geometry, pairs) + shadow_findings(scene.views)
        if ties is not None:
            findings.entries += tie_findings(names, ties.orientation, pairs, config.orientation)
            unusable = [each.name for each in usable_views.refused]
            advice = image_advice(names, ties.orientation, pairs, config.selection, unusable)
            findings.entries += plane_findings(corrected, request.inputs, ties.orientation)
            plan = planned(request, config, corrected, ties, geometry, findings)
    return Diagnosis(
        scene.views,
        tuple(quality),
        geometry,
        pairs,
        ties,
        plan,
        usable_views.refused,
        tuple(advice),
        tuple(dict.fromkeys(findings.entries)),
    )


def found_ties(
    scene: Scene,
    levels: list[float],
    config: RunConfig,
    asked: tuple[float, float] | None,
    findings: Findings,
    progress: Progress,
) -> QuickTies | None:
    """Tie points of a quick pass; None where the images do not overlap."""
    if findings.refuses(lambda: check_overlap(scene, levels)):
        return None
    return findings.tried(lambda: quick_ties(scene, config, asked, progress))


def ground_height(ties: QuickTies | None, levels: Sequence[float]) -> float:
    """Height of the ground, m: the median of the tie points, or else of the possible heights."""
    if ties is not None and len(ties.orientation.xyz):
        z = float(np.nanmedian(ties.orientation.xyz[:, 2]))
        if np.isfinite(z):
            return z
    return float(np.median(levels))


def planned(
    request: DoctorRequest,
    config: RunConfig,
    corrected: Scene,
    ties: QuickTies,
    geometry: Sequence[ViewGeometry],
    findings: Findings,
) -> Any:
    """The plan of a run; None where the run would fail before."""
    plan = findings.tried(lambda: run_plan(request, config, corrected, ties, [each.outline for each in geometry]))
    if plan is not None:
        findings.entries += plan_findings(plan, request.memory_gb)
    return plan


def write_diagnosis(out: Path, diagnosis: Diagnosis, scene: Scene | None, options: ProductOptions) -> None:
    """Write doctor.json, and footprints where they are known; footprints of an earlier check are removed.

    options : say whether footprints get a style.

    Raises
    ------
    OutputError
        They cannot be written.
    """
    with made_folder(out):
        for name in (FOOTPRINTS, PICTURE):
            (out / name).unlink(missing_ok=True)
        if scene is not None and diagnosis.geometry:
            outlines = [each.outline for each in diagnosis.geometry]
            features = [
                (outline, {"kind": "image", "name": view.name, **diagnosis.view_record(i)})
                for i, (view, outline) in enumerate(zip(diagnosis.views, outlines, strict=True))
            ]
            features += [(pair.shared, {"kind": "overlap", **diagnosis.pair_record(pair)}) for pair in diagnosis.pairs]
            write_footprints(out / FOOTPRINTS, features, scene.crs)
            footprints_picture(out / PICTURE, outlines, diagnosis.names)
        write_other_styles(out, (FOOTPRINTS,), options)
        write_record(out / REPORT, diagnosis.as_dict())
