"""The diagnosis as text and as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from zlocus.core.footprints import PairGeometry, ViewGeometry
from zlocus.core.quoting import counted
from zlocus.core.scene import View
from zlocus.io.scene_file import RefusedView
from zlocus.orientation.parameter_groups import kind_of
from zlocus.orientation.tie_residuals import PairOrientation, ViewOrientation
from zlocus.pipeline.doctor.findings import NOTE, POOR, STOPS, VERDICTS, Finding, worst
from zlocus.pipeline.doctor.plan import ROUGHLY, RunPlan
from zlocus.pipeline.doctor.quality import ImageQuality, percent
from zlocus.pipeline.doctor.ties import QuickTies
from zlocus.pipeline.extent import above
from zlocus.products.acquisitions import COLUMNS, acquisition_record, acquisition_records, acquisition_rows

MOST_PAIRS = 30
HEADINGS = {STOPS: "What will not work", POOR: "What may go wrong", NOTE: "Also"}
VERDICT_WORDS = {STOPS: "fails", POOR: "doubtful", NOTE: "good"}


@dataclass(frozen=True)
class Diagnosis:
    """Result of the doctor, as far as the inputs could be examined.

    views, quality : of the same length, None for an image that cannot be read; geometry : as long as views, or empty;
    pairs : of views that share ground; refused : views that could not be opened; advice : sentences on which images to
    keep, drop and buy, none without tie points.
    """

    views: tuple[View, ...]
    quality: tuple[ImageQuality | None, ...]
    geometry: tuple[ViewGeometry, ...]
    pairs: tuple[PairGeometry, ...]
    ties: QuickTies | None
    plan: RunPlan | None
    refused: tuple[RefusedView, ...]
    advice: tuple[str, ...]
    findings: tuple[Finding, ...]

    @property
    def will_fail(self) -> bool:
        """Whether a run would fail."""
        return worst(self.findings) == STOPS

    @property
    def names(self) -> list[str]:
        """Names of the views."""
        return [view.name for view in self.views]

    @property
    def text(self) -> str:
        """The report as text."""
        quick = (
            "" if self.ties is None or not self.ties.is_quick else "Ties are of a quick pass: a run finds more of them."
        )
        taken = _table("How the images were taken", [COLUMNS, *acquisition_rows(acquisition_records(self.views))])
        parts = [
            _table("Images", _view_rows(self)),
            taken,
            _table("Pairs", _pair_rows(self)),
            quick,
            *_plan_lines(self),
        ]
        sections = {
            heading: tuple(finding.sentence for finding in self.findings if finding.level == level)
            for level, heading in HEADINGS.items()
        }
        sections["Which images"] = self.advice
        for heading, told in sections.items():
            parts.append("\n".join([heading, *(f"- {sentence}" for sentence in told)]) if told else "")
        return "\n\n".join([part for part in parts if part] + [VERDICTS[worst(self.findings)]])

    def as_dict(self) -> dict[str, Any]:
        """The content of doctor.json."""
        return {
            "verdict": VERDICT_WORDS[worst(self.findings)],
            "findings": [
                {"level": finding.level, "views": list(finding.about), "sentence": finding.sentence}
                for finding in self.findings
            ],
            "views": {view.name: self.view_record(i) for i, view in enumerate(self.views)},
            "refused": {each.name: {"path": str(each.path), "reason": each.reason} for each in self.refused},
            "pairs": [self.pair_record(pair) for pair in self.pairs],
            "quick_ties": None if self.ties is None else self.ties.is_quick,
            "advice": list(self.advice),
            "plan": None if self.plan is None else _plan_record(self.plan),
        }

    def view_record(self, number: int) -> dict[str, Any]:
        """The record of a view."""
        view, quality = self.views[number], self.quality[number]
        record: dict[str, Any] = {
            "path": str(view.path),
            "sensor": kind_of(view.sensor),
            "shape": list(view.image.shape),
            **acquisition_record(view.acquisition),
        }
        if quality is not None:
            record |= {
                "nodata": _rounded(quality.nodata),
                "masked": None if quality.masked is None else _rounded(quality.masked),
                "saturated": _rounded(quality.saturated),
                "black": _rounded(quality.black),
                "edge_px": _rounded(quality.edge_px),
            }
        if self.geometry:
            found = self.geometry[number]
            record |= {
                "ground_px_m": _rounded(found.ground_px_m),
                "closing_px": _rounded(found.closing_px, 6),
                "not_mapped": _rounded(found.lost),
            }
        oriented = self.oriented(number)
        if oriented is not None:
            record |= {
                "n_ties": oriented.n_ties,
                "shift_px": [_rounded(shift) for shift in oriented.shift_px],
                "residual_before_px": oriented.residuals_before.as_dict(),
                "residual_after_px": oriented.residuals_after.as_dict(),
            }
        return record

    def pair_record(self, pair: PairGeometry) -> dict[str, Any]:
        """The record of a pair of views."""
        found = self.tied(pair)
        return {
            "views": [self.names[i] for i in pair.views],
            "overlap": _rounded(pair.overlap),
            "base_to_height": _rounded(pair.base_to_height),
            "n_ties": None if self.ties is None else 0 if found is None else found.n_ties,
            "epipolar_distance_before_px": None if found is None else _rounded(found.epipolar_distance_before_px),
            "epipolar_distance_after_px": None if found is None else _rounded(found.epipolar_distance_after_px),
        }

    def oriented(self, number: int) -> ViewOrientation | None:
        """The orientation of a view; None where there is none."""
        return None if self.ties is None else self.ties.orientation.views[number]

    def tied(self, pair: PairGeometry) -> PairOrientation | None:
        """The orientation of a pair of views; None where no tie points connect it."""
        found = () if self.ties is None else self.ties.orientation.pairs
        wanted = {self.names[i] for i in pair.views}
        return next((each for each in found if set(each.views) == wanted), None)


def _view_rows(diagnosis: Diagnosis) -> Iterator[Sequence[str]]:
    yield (
        "name", "sensor", "rows x cols", "ground pixel", "nodata", "saturated", "black", "edges", "ties", "off before",
        "off after",
    )  # fmt: skip
    greys: tuple[str, ...]
    ties: tuple[str, ...]
    for i, view in enumerate(diagnosis.views):
        quality, oriented = diagnosis.quality[i], diagnosis.oriented(i)
        greys = ("-",) * 4
        if quality is not None:
            shares = (percent(share) for share in (quality.nodata, quality.saturated, quality.black))
            greys = (*shares, _unit(quality.edge_px, "px"))
        ties = ("-",) * 3
        if oriented is not None:
            ties = (
                str(oriented.n_ties),
                *(_unit(each.median, "px") for each in (oriented.residuals_before, oriented.residuals_after)),
            )
        pixel = _unit(diagnosis.geometry[i].ground_px_m, "m") if diagnosis.geometry else "-"
        rows, cols = view.image.shape
        yield view.name, kind_of(view.sensor), f"{rows} x {cols}", pixel, *greys, *ties
    for refused in diagnosis.refused:
        yield (refused.name, "cannot be used", *("-",) * 9)


def _pair_rows(diagnosis: Diagnosis) -> Iterator[Sequence[str]]:
    yield "pair", "overlap", "base-to-height", "ties", "off before", "off after"
    largest = sorted(diagnosis.pairs, key=lambda pair: -pair.overlap)
    for pair in largest[:MOST_PAIRS]:
        tied = diagnosis.tied(pair)
        ties = ("-" if diagnosis.ties is None else "0", "-", "-")
        if tied is not None:
            ties = (
                str(tied.n_ties),
                _unit(tied.epipolar_distance_before_px, "px"),
                _unit(tied.epipolar_distance_after_px, "px"),
            )
        names = " - ".join(diagnosis.names[i] for i in pair.views)
        yield names, percent(pair.overlap), f"{pair.base_to_height:.2f}", *ties
    if len(largest) > MOST_PAIRS:
        yield f"and {len(largest) - MOST_PAIRS} pairs that overlap less (see doctor.json)", *("",) * 5


def _plan_lines(diagnosis: Diagnosis) -> Iterator[str]:
    plan = diagnosis.plan
    if plan is None:
        return
    low, high = plan.heights
    rows, cols = plan.shape
    memory = f"{plan.tile_bytes * plan.workers / 1e9:.2f} GB"
    machine = "" if plan.machine_bytes is None else f"; this machine has {plan.machine_bytes / 1e9:.1f} GB"
    which = "A run of the images that can be used" if diagnosis.refused else "A run"
    yield "\n".join(
        [
            which,
            f"- searches heights from {low:.1f} to {high:.1f} m {above(plan.extent.crs)}, {plan.n_steps} steps of "
            f"{plan.step_m:.2g} m;",
            f"- makes {rows} rows x {cols} columns of {plan.cell_m:g} m in {counted(plan.n_tiles, 'tile')}, "
            f"{plan.workers} at a time;",
            f"- covers, in {plan.extent.crs_text}, {plan.extent};",
            f"- needs about {memory} for its tiles{machine};",
            f"- matches for about {duration(plan.seconds)}. This is a rough estimate, {plan.view_cells / 1e6:.2g} "
            f"million cells times images at the rate of the benchmarks; it may be {ROUGHLY:g} times as long or short.",
        ]
    )


def _plan_record(plan: RunPlan) -> dict[str, Any]:
    record = {name: _rounded(value) if isinstance(value, float) else value for name, value in vars(plan).items()}
    extent = {"crs": plan.extent.crs.to_string(), **plan.extent.as_dict()}
    return record | {
        "extent": extent,
        "shape": list(plan.shape),
        "heights": [_rounded(z) for z in plan.heights],
        "rough_factor": ROUGHLY,
    }


def _table(heading: str, rows: Iterable[Sequence[str]]) -> str:
    """A table as lines of text: rows under a heading, with aligned columns; no lines without a row."""
    cells = list(rows)
    if len(cells) < 2:
        return ""
    widths = [max(map(len, column)) for column in zip(*(row for row in cells if row[1]), strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
    return "\n".join([heading, *(f"  {line}" for line in lines)])


def _unit(value: float, unit: str) -> str:
    return f"{value:.2f} {unit}" if math.isfinite(value) else "-"


def duration(seconds: float) -> str:
    """A duration, rounded roughly: 8 s, 5 min, 3.5 h."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _rounded(value: float, digits: int = 4) -> float | None:
    return round(float(value), digits) if math.isfinite(value) else None
