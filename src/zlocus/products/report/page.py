"""report.html: the report of a run as one page that needs no other file."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pyproj import CRS, Transformer

from zlocus.core.errors import InputError
from zlocus.core.requests import EVENTS
from zlocus.core.scene import is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.io.atomic_write import write_atomically
from zlocus.io.run_record import check_not_aligned, read_record
from zlocus.matching.quality import Quality, flags_of
from zlocus.products.acquisitions import COLUMNS, acquisition_rows
from zlocus.products.derived import FILES
from zlocus.products.match_curve_drawing import SVG_PX
from zlocus.products.ortho_colours import colour_sentence
from zlocus.products.report import maps, tables
from zlocus.products.report import text as words
from zlocus.products.report.command_line import command_line
from zlocus.products.report.file_names import CURVES, FOOTPRINTS, RANKING, RECORD, REPORT
from zlocus.products.report.sampling import Survey, survey_rasters
from zlocus.products.stac_item import PRODUCTS

if TYPE_CHECKING:
    from zlocus.evaluation.comparison import Comparison

HERE = Path(__file__).parent
NEEDED = ("config", "versions", "inputs", "stages", "orientation", "grid", "heights", "coverage")
QUANTILES = (10, 25, 50, 75, 90)
LABEL_WORDS = {1: "good", 0: "fair", -1: "poor"}
KIND_WORDS = {"typical": "Typical", "doubtful": "Doubtful", "failed": "No height"}
MAX_NUMBERED_OUTLINES = 40
DRAWING_SIDE = 1000.0
# Width and height of a number in the drawing, and places on each side of an outline where it may stand.
NUMBER_BOX, PLACES_PER_SIDE = np.array([56.0, 44.0]), 8
# Colours of outlines and their numbers, which colour-blind readers can distinguish on white.
OUTLINE_COLOURS = ("#0072b2", "#b03a00", "#00704f", "#8f3f71", "#8a6100", "#5b4bb5", "#8b3a2b", "#444444")
# The only script of the page opens folded tables before printing.
SCRIPT = 'addEventListener("beforeprint",()=>document.querySelectorAll("details").forEach(d=>{d.open=true}));'


@dataclass(frozen=True)
class Outline:
    """Outline of an image on the ground.

    number : of the image in the table of images; points : SVG coordinates; colour : CSS; at : place of its number, None
    where there is no room.
    """

    number: int
    name: str
    points: str
    colour: str
    at: tuple[float, float] | None


class FileRow(NamedTuple):
    """A file of the result. size : in words."""

    name: str
    title: str
    size: str


def write_report(out: Path, comparison: Comparison | None = None) -> Path:
    """Write report.html of the run in a folder, complete or not at all, and return its path.

    Raises
    ------
    InputError
        There is no complete run in the folder, or the reference cannot be used.
    ConfigError
        See `evaluate`.
    OutputError
        The report cannot be written.
    """
    text = rendered(context(out, comparison))
    write_atomically(out / REPORT, lambda part: part.write_text(text, encoding="utf-8"))
    return out / REPORT


def rendered(values: Mapping[str, Any], template: str = "page.html.jinja") -> str:
    """A page, rendered from the values of its template: those of `context` for the report."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    from zlocus.products.report.compiled_page import CompiledPages

    environment = Environment(
        loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        bytecode_cache=CompiledPages(HERE / "__pycache__"),
    )  # fmt: skip
    digest = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode("ascii")
    return environment.get_template(template).render(**values, script=SCRIPT, script_hash=digest) + "\n"


def context(out: Path, comparison: Comparison | None) -> dict[str, Any]:
    """Values of the page's template."""
    run = run_record(out)
    check_not_aligned(run, out / RECORD)
    survey, crs = survey_rasters(out), CRS.from_user_input(run["grid"]["crs"])
    if is_local(crs):
        survey = replace(survey, height_name="z of the local frame")
    sigma = survey.sigma[np.isfinite(survey.sigma)]
    quantiles = {q: float(np.percentile(sigma, q)) for q in QUANTILES} if sigma.size else {}
    where, frame = words.place(survey, crs)
    light = run["config"]["options"]["products"]
    sun_deg = (light["sun_azimuth_deg"], light["sun_altitude_deg"])
    views = run["orientation"]["views"]
    reference = None
    if comparison is not None:
        from zlocus.products.report.comparison import comparison_part

        reference = comparison_part(out, comparison)
    paragraph = words.summary(survey, run, crs, quantiles)
    if reference is not None:
        paragraph += " " + reference["sentence"]
    return {
        "title": out.resolve().name, "version": run["versions"]["zlocus"], "summary": paragraph, "where": where,
        "frame": frame, "is_local": is_local(crs), "run": run, "survey": survey,
        "footprints": footprints_part(out / FOOTPRINTS, survey, crs, list(views)),
        "command": command_line(run), "started_in": run.get("started_in", ""), "files": file_rows(out),
        "heights": maps.height_map(out / "dsm.tif", survey, sun_deg), **derived_maps(out, survey, light, sun_deg),
        "sun": words.sun(*sun_deg),
        "corners": words.corners(survey, is_local(crs)), "bar": maps.scale_bar(survey.shape[1] * survey.cell_m),
        "ortho": maps.ortho_map(out), "colours": colour_sentence(run.get("colours", {})),
        "created": words.when(run.get("created")),
        "sigma": maps.sigma_map(out),
        "quantiles": [(f"{q} %", words.size(value, "m")) for q, value in quantiles.items()],
        "used": maps.views_map(survey), "reasons": words.reasons(survey), "reasons_map": maps.reasons_map(survey),
        "absent": words.listed([str(flag.name) for flag in Quality if not survey.count(flag)]),
        "images": tables.image_rows(views), "masked": words.masks(run.get("masked_shares", {})),
        "taken": acquisition_rows(run.get("acquisitions", {})), "taken_columns": COLUMNS,
        **pairs_part(out, run), "curves": curves_part(out / CURVES, run),
        "reference": reference, "stages": tables.stage_rows(run["stages"]),
        "request": tables.request_rows(run["config"]["request"]),
        "options": tables.option_rows(run["config"]["options"]),
    }  # fmt: skip


def file_rows(out: Path) -> list[FileRow]:
    """The files of a result, in the order of its catalogue item, which is written after the report.

    The event log has no size: later commands add to it, and the same page would have another one.
    """
    return [
        FileRow(
            product.name,
            product.title,
            "" if product.name == EVENTS else _size_words((out / product.name).stat().st_size),
        )
        for product in PRODUCTS
        if product.name != REPORT and (out / product.name).is_file()
    ]


def _size_words(size: int) -> str:
    """A number of bytes in words."""
    return f"{size / 1e6:.3g} MB" if size >= 1e5 else f"{max(size / 1e3, 0.1):.2g} kB"


def derived_maps(out: Path, survey: Survey, light: Mapping[str, Any], sun_deg: tuple[float, float]) -> dict[str, Any]:
    """Maps of the terrain and of the contours, None without; `contours_note` says of what, or why they are not drawn.

    light : options of the products.
    """
    terrain, contours = out / FILES["dtm"], out / FILES["contours"]
    drawn_from = terrain if light["contours_of"] == "dtm" and terrain.exists() else out / "dsm.tif"
    shown = maps.contour_map(contours, drawn_from, sun_deg) if contours.exists() else None
    note = f"Contours of the {'terrain' if drawn_from == terrain else 'surface'}, one in five thick."
    if contours.exists() and shown is None:
        note = f"{FILES['contours']} holds more lines than a map of this size can show."
    return {
        "terrain": maps.height_map(terrain, survey, sun_deg) if terrain.exists() else None,
        "contours": shown, "contours_note": note if contours.exists() else "",
    }  # fmt: skip


def run_record(out: Path) -> dict[str, Any]:
    """run.json of a surface.

    Raises
    ------
    InputError
        It is missing, damaged, or not of a surface.
    """
    path = out / RECORD
    if not path.is_file():
        raise InputError(f"There is no {RECORD} in {out}. Give the folder that `zlocus dsm` wrote (-o).")
    run = read_record(path)
    missing = [key for key in NEEDED if key not in run]
    if missing:
        raise InputError(
            f"{path} lacks {', '.join(missing)}: it is not of a surface, or damaged. Give the folder of a `zlocus dsm`."
        )
    return run


def footprints_part(path: Path, survey: Survey, crs: CRS, names: Sequence[str]) -> dict[str, Any] | None:
    """Outlines of images and surface in a drawing of `DRAWING_SIDE` a side, y down; None without footprints."""
    rings = footprint_rings(path, crs)
    if not rings or not set(rings) <= set(names):
        return None
    rows, cols = survey.shape
    area = np.array([survey.transform * corner for corner in ((0, 0), (cols, 0), (cols, rows), (0, rows))])
    everything = np.concatenate([area, *rings.values()])
    low, high = everything.min(axis=0), everything.max(axis=0)
    scale = DRAWING_SIDE / max(*(high - low), 1e-9)
    width, height = (high - low) * scale

    def drawn(xy: FloatArray) -> FloatArray:
        return np.asarray(np.column_stack([xy[:, 0] - low[0], high[1] - xy[:, 1]]) * scale)

    def points(xy: FloatArray) -> str:
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in drawn(xy))

    shown = [(i, name) for i, name in enumerate(names) if name in rings]
    is_numbered = len(shown) <= MAX_NUMBERED_OUTLINES
    places = number_places([drawn(rings[name]) for _, name in shown]) if is_numbered else [None] * len(shown)
    shapes = [
        Outline(i + 1, name, points(rings[name]), OUTLINE_COLOURS[i % len(OUTLINE_COLOURS)], at)
        for (i, name), at in zip(shown, places, strict=True)
    ]
    return {
        "shapes": shapes, "area": points(area), "width": f"{width:.1f}", "height": f"{height:.1f}",
        "span_m": [words.size(float(v), "m") for v in high - low],
    }  # fmt: skip


def number_places(rings: Sequence[FloatArray]) -> list[tuple[float, float] | None]:
    """Place of each outline's number, on the outline and clear of other numbers; None where there is no room.

    rings : outlines (n, 2) in units of the drawing. Each number takes the place on its outline that is farthest from
    the numbers before it.
    """
    placed: list[FloatArray] = []
    places: list[tuple[float, float] | None] = []
    for ring in rings:
        steps = np.arange(PLACES_PER_SIDE) / PLACES_PER_SIDE
        closed = np.concatenate([ring, ring[:1]])
        at = (closed[:-1, None] + steps[:, None] * np.diff(closed, axis=0)[:, None]).reshape(-1, 2)
        # Distances are in boxes that hold two digits; boxes closer than 1 overlap.
        apart = [np.abs((at - other) / NUMBER_BOX).max(axis=1) for other in placed]
        room = np.min(apart, axis=0) if apart else np.full(len(at), np.inf)
        best = int(room.argmax())
        if room[best] < 1:
            places.append(None)
            continue
        placed.append(at[best])
        places.append((round(float(at[best, 0]), 1), round(float(at[best, 1]), 1)))
    return places


def footprint_rings(path: Path, crs: CRS) -> dict[str, FloatArray]:
    """Outlines (n, 2) m of the images by name, in the surface's CRS; images without an outline are left out."""
    rings = {}
    back = None if is_local(crs) else Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    for feature in features(path, "image"):
        if feature["geometry"] is not None:
            ring = np.array(feature["geometry"]["coordinates"][0], float)
            rings[feature["properties"]["name"]] = ring if back is None else np.column_stack(back.transform(*ring.T))
    return rings


def features(path: Path, kind: str) -> list[dict[str, Any]]:
    """Features of one kind in footprints.geojson; none without the file."""
    if not path.exists():
        return []
    return [each for each in read_record(path)["features"] if each["properties"]["kind"] == kind]


def pairs_part(out: Path, run: Mapping[str, Any]) -> dict[str, Any]:
    """Matrices of labels and of pairs, or the reasons why there are none."""
    names = list(run["orientation"]["views"])
    if len(names) > tables.MAX_MATRIX_IMAGES:
        why = f"There are {len(names)} images, too many for a matrix."
        return {"labels": None, "n_sampled": 0, "no_labels": f"{why} See {RANKING}.", "pairs": None, "no_pairs": why}
    labels = label_part(out, names)
    overlaps = [each["properties"] for each in features(out / FOOTPRINTS, "overlap")]
    known = [each for each in overlaps if set(each["views"]) <= set(names)]
    return {
        "labels": labels.matrix, "n_sampled": labels.n_sampled, "no_labels": labels.why_none,
        "pairs": tables.pair_matrix(names, run["orientation"]["pairs"], known), "no_pairs": "",
    }  # fmt: skip


class LabelPart(NamedTuple):
    """Matrix of labels.

    matrix : None where there is none; n_sampled : number of points in a sample, 0 where images were ranked everywhere;
    why_none : reason why there is no matrix.
    """

    matrix: tables.Matrix | None
    n_sampled: int
    why_none: str


def label_part(out: Path, names: Sequence[str]) -> LabelPart:
    """Matrix of labels from the ranking of the run, or else from the sample that was made for the report."""
    labels = tables.label_matrix(out / RANKING, names)
    sample = read_record(out / CURVES).get("labels", {}) if (out / CURVES).exists() else {}
    if labels is not None or not sample:
        why_none = f"The run wrote no ranking of these images ({RANKING}), and no sample of one ({CURVES})."
        return LabelPart(labels, 0, why_none)
    if "error" in sample:
        return LabelPart(None, 0, f"The sample could not be made: {sample['error']}")
    matrix = tables.sampled_matrix(sample["pairs"], names) if sample["pairs"] else None
    return LabelPart(matrix, sample["points"], "No tie point lies where two images were compared.")


def curves_part(path: Path, run: Mapping[str, Any]) -> dict[str, Any] | None:
    """Example cells with their match curves; None without curves.json."""
    if not path.exists():
        return None
    record = read_record(path)
    return {
        "rule": record["rule"], "n_left_out": record["n_chosen"] - len(record["cells"]),
        "cells": [curve_card(cell, run) for cell in record["cells"]],
    }  # fmt: skip


def curve_card(cell: Mapping[str, Any], run: Mapping[str, Any]) -> dict[str, Any]:
    """Values of the template for a cell and its match curves."""
    names = [str(flag.name) for flag in flags_of(cell["quality"])]
    lines = [
        f"Row {cell['row']}, column {cell['col']} of the grid, at {cell['x']:.1f}, {cell['y']:.1f} m. "
        f"Reasons: {words.listed(names)}."
    ]
    if cell["height_m"] is not None:
        sigma = words.size(cell["sigma_m"], "m")
        lines.append(f"The surface has {cell['height_m']:.2f} m, standard deviation {sigma}.")
    why = cell["why"] if cell["kind"] == "typical" else f"{cell['why']}: {words.MEANINGS[Quality[cell['why']]]}"
    card = {"heading": f"{KIND_WORDS[cell['kind']]}: {why}", "lines": lines, "error": cell.get("error", "")}
    if card["error"]:
        return card
    point, n = cell["point"], cell["n_shown"]
    mean = point["means"][n - 1]
    n_all = len(point["means"])
    of = "The curve of the search image" if n_all == 1 else f"The mean of {n} of {n_all} search images"
    says = (
        f"{of} with {point['reference']} is "
        f"{LABEL_WORDS[mean['label']]}: largest correlation {words.number(mean['rho1'])}, "
        f"{words.number(mean['ratio'])} times its secondary peak, at {words.number(mean['peak_m'], 'm')}."
    )
    uri = maps.data_uri(cell["svg"].encode(), "image/svg+xml")
    alt = f"Correlation against height at this cell. {says}"
    lines.append(says)
    if cell["kind"] == "failed":
        undulation_m = cell.get("undulation_m", 0.0)
        despite = words.despite_peak(Quality[cell["why"]], mean["rho1"], run, undulation_m)
        lines += [despite] if despite else []
    return card | {"lines": lines, "picture": maps.Picture(uri, alt, *SVG_PX)}
