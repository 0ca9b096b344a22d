"""metadata.xml: lineage (ISO 19115-1) and quality (ISO 19157) of a surface, encoded by ISO 19115-3 and ISO 19157-2.

Every figure is one of run.json, with the same digits, or of the evaluation in the folder; the identifier of its measure
says which (`run.json#/sigma/rms_m`, a JSON pointer). Only the extent in degrees is that of item.json.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

from pyproj import CRS

from zlocus.core.requests import DEMO_ACCURACY, EVALUATION_FILES
from zlocus.core.scene import is_local
from zlocus.io.atomic_write import write_atomically
from zlocus.io.iso_xml import UNITS, citation, code, document, element, identifier, instant, number, text, typed_date
from zlocus.io.run_record import read_record
from zlocus.products.surface_footprint import footprint_of

METADATA, RECORD = "metadata.xml", "run.json"
NEEDED = (
    "config", "command", "created", "processor", "versions", "inputs", "orientation", "grid", "vertical", "coverage",
    "cells", "sigma", "surface_range_m", "rasters", "stages",
)  # fmt: skip
# What a surface is, of which a record may speak.
SCOPE = "dataset"
# Entries of an evaluation that are stated: their measures, and what they mean.
ACCURACY = {
    "rmse": ("root mean square error", "Root mean square of the differences of the heights from the reference."),
    "le90": ("linear error at 90 % significance level", "Absolute difference that 90 % of the heights do not exceed."),
    "le95": ("linear error at 95 % significance level", "Absolute difference that 95 % of the heights do not exceed."),
    "mean": ("bias of positions", "Mean difference of the heights from the reference."),
    "median": ("median difference", "Median difference of the heights from the reference."),
    "nmad": ("normalised median absolute deviation", "Robust standard deviation of the differences."),
}
# Points of an evaluation at check points by their ground, and the entries that are stated of each.
POINT_KINDS = {"nva": "non-vegetated", "vva": "vegetated"}
POINT_ACCURACY = {"rmse_v": ("vertical accuracy, RMSE_V", "m"), "n_compared": ("number of points compared", "")}
# The same of standard deviations, in `sigma` of run.json.
SIGMA = {
    "mean_m": "mean standard deviation of the heights",
    "rms_m": "root mean square standard deviation of the heights",
    "median_m": "median standard deviation of the heights",
    "percentile_95_m": "standard deviation that 95 % of the heights do not exceed",
}
# Counts of cells, in `cells` of run.json.
COUNTS = {
    "grid": "cells of the grid", "asked": "cells inside the area that was asked for",
    "seen": "cells seen by two images or more, without levelled water", "heights": "cells with a height",
    "matched": "cells whose height was matched", "filled": "cells whose height was filled or given",
    "water": "cells of levelled water",
}  # fmt: skip


class Figure(NamedTuple):
    """A number of a record. pointer : where it stands, `file#/key/key`; unit : "m", "px", or "" for counts."""

    pointer: str
    name: str
    value: float
    unit: str = ""
    description: str = ""


def write_metadata(folder: Path) -> bool:
    """Write metadata.xml of the surface in a folder; return False, and write nothing, where run.json does not tell all.

    Raises
    ------
    InputError
        run.json or dsm.tif is damaged.
    OutputError
        The file cannot be written.
    """
    run = read_record(folder / RECORD) if (folder / RECORD).is_file() else {}
    if any(key not in run for key in NEEDED):  # of an earlier version
        return False
    bbox = None if is_local(CRS.from_user_input(run["grid"]["crs"])) else footprint_of(folder / "dsm.tif").bbox
    content = document(_metadata(run, bbox, _evaluation(folder, run)))
    if (folder / METADATA).is_file() and (folder / METADATA).read_bytes() == content:
        return True
    write_atomically(folder / METADATA, lambda part: part.write_bytes(content))
    return True


def _evaluation(folder: Path, run: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]] | None:
    """The evaluation in a folder, with the name of its file; None without one, or where parts were redone since."""
    last = datetime.fromisoformat(run["redone"][-1]["time"]).timestamp() if run.get("redone") else 0.0
    for name in (EVALUATION_FILES[0], DEMO_ACCURACY):
        if (folder / name).is_file() and (folder / name).stat().st_mtime >= last:
            found = read_record(folder / name)
            if isinstance(found.get("absolute"), dict) and isinstance(found["absolute"].get("all"), dict):
                return name, found
    return None


def _metadata(
    run: Mapping[str, Any], bbox: list[float] | None, evaluation: tuple[str, Mapping[str, Any]] | None
) -> Element:
    """The root element. bbox : west, south, east and north in degrees, None in a local frame."""
    created = str(run["created"])
    last = str(run["redone"][-1]["time"]) if run.get("redone") else created
    return element(
        "mdb:MD_Metadata",
        identifier("mdb:metadataIdentifier", str(run["rasters"]["dsm.tif"]), "SHA-256 of dsm.tif"),
        element("mdb:metadataScope", element("mdb:MD_MetadataScope", _code_of_scope("mdb:resourceScope"))),
        element("mdb:contact", gco_nilReason="missing"),
        typed_date("mdb:dateInfo", created, "creation"),
        typed_date("mdb:dateInfo", last, "revision") if last != created else None,
        citation("mdb:metadataStandard", "ISO 19115-1", text("cit:edition", "2014")),
        _grid(run),
        *_reference_systems(run),
        _identification(run, bbox, created, last),
        element("mdb:dataQualityInfo", _quality(run, evaluation)),
        element("mdb:resourceLineage", _lineage(run)),
    )


def _code_of_scope(name: str) -> Element:
    return code(name, "mcc:MD_ScopeCode", SCOPE)


def _grid(run: Mapping[str, Any]) -> Element:
    """The grid: rows and columns, and the size of a cell."""
    rows, cols = run["grid"]["shape"]
    cell_m = run["grid"]["transform"][0]
    axes = [
        element(
            "msr:axisDimensionProperties",
            element(
                "msr:MD_Dimension",
                code("msr:dimensionName", "msr:MD_DimensionNameTypeCode", axis),
                number("msr:dimensionSize", size, "gco:Integer"),
                number("msr:resolution", cell_m, "gco:Measure", uom="m"),
            ),
        )
        for axis, size in (("row", rows), ("column", cols))
    ]
    return element(
        "mdb:spatialRepresentationInfo",
        element(
            "msr:MD_GridSpatialRepresentation",
            number("msr:numberOfDimensions", 2, "gco:Integer"),
            *axes,
            code("msr:cellGeometry", "msr:MD_CellGeometryCode", "area"),
            text("msr:transformationParameterAvailability", "true", "gco:Boolean"),
        ),
    )


def _reference_systems(run: Mapping[str, Any]) -> Iterator[Element]:
    """The CRS of the map and the surface above which heights are counted."""
    vertical = run["vertical"]
    named = str(vertical.get("crs") or f"heights above {vertical['heights_above']}")
    for name, kind in ((str(run["grid"]["crs"]), "projected"), (named, "vertical")):
        authority, colon, number_of = name.partition(":")
        is_code = bool(colon) and number_of.isdigit()
        yield element(
            "mdb:referenceSystemInfo",
            element(
                "mrs:MD_ReferenceSystem",
                identifier(
                    "mrs:referenceSystemIdentifier", number_of if is_code else name, authority if is_code else None
                ),
                code("mrs:referenceSystemType", "mrs:MD_ReferenceSystemTypeCode", kind),
            ),
        )


def _identification(run: Mapping[str, Any], bbox: list[float] | None, created: str, last: str) -> Element:
    request, version, n = run["config"]["request"], run["versions"]["zlocus"], len(run["orientation"]["views"])
    abstract = (
        f"Heights of the surface from {n} overlapping images, matched by zlocus {version} (method {request['method']}, "
        f"selection {request['selection']})."
    )
    return element(
        "mdb:identificationInfo",
        element(
            "mri:MD_DataIdentification",
            citation(
                "mri:citation", "Digital surface model", typed_date("cit:date", created, "creation"),
                typed_date("cit:date", last, "revision") if last != created else None,
            ),
            text("mri:abstract", abstract),
            code("mri:spatialRepresentationType", "mcc:MD_SpatialRepresentationTypeCode", "grid"),
            element(
                "mri:spatialResolution",
                element(
                    "mri:MD_Resolution",
                    number("mri:distance", run["grid"]["transform"][0], "gco:Distance", uom="m"),
                ),
            ),
            text("mri:topicCategory", "elevation", "mri:MD_TopicCategoryCode"),
            element("mri:extent", _extent(run, bbox)),
        ),
    )  # fmt: skip


def _extent(run: Mapping[str, Any], bbox: list[float] | None) -> Element:
    """Where and between which heights the surface lies, and when the images were taken."""
    box, period, vertical = None, None, None
    if bbox is not None:
        sides = ("westBoundLongitude", "eastBoundLongitude", "southBoundLatitude", "northBoundLatitude")
        values = (bbox[0], bbox[2], bbox[1], bbox[3])
        degrees = [number(f"gex:{side}", value, "gco:Decimal") for side, value in zip(sides, values, strict=True)]
        box = element("gex:geographicElement", element("gex:EX_GeographicBoundingBox", *degrees))
    if dates := sorted(str(date) for date in run.get("image_dates", []) if date):
        begin, end = element("gml:beginPosition"), element("gml:endPosition")
        begin.text, end.text = dates[0], dates[-1]
        inner = element("gml:TimePeriod", begin, end, gml_id="period-of-images")
        period = element("gex:temporalElement", element("gex:EX_TemporalExtent", element("gex:extent", inner)))
    low, high = run["surface_range_m"]
    if low is not None:
        heights = number("gex:minimumValue", low), number("gex:maximumValue", high)
        vertical = element("gex:verticalElement", element("gex:EX_VerticalExtent", *heights))
    local = text("gex:description", "In a local frame, at no place of the Earth.") if bbox is None else None
    return element("gex:EX_Extent", local, box, period, vertical)


def _quality(run: Mapping[str, Any], evaluation: tuple[str, Mapping[str, Any]] | None) -> Element:
    """The data quality unit: accuracy against a reference, precision, cameras, and completeness."""
    elements = [
        *([] if evaluation is None else _absolute(*evaluation)),
        *(_reported("DQ_GriddedDataPositionalAccuracy", figure, "indirect") for figure in sigma_figures(run)),
        *(_reported("DQ_RelativeInternalPositionalAccuracy", figure, "direct") for figure in tie_figures(run)),
        *(_reported("DQ_CompletenessOmission", figure, "direct") for figure in completeness_figures(run)),
    ]
    scope = element("mdq:scope", element("mcc:MD_Scope", _code_of_scope("mcc:level")))
    return element("mdq:DQ_DataQuality", scope, *(element("mdq:report", each) for each in elements))


def _absolute(name: str, evaluation: Mapping[str, Any]) -> Iterator[Element]:
    found = evaluation["absolute"]["all"]
    for key, (measure, description) in ACCURACY.items():
        if found.get(key) is not None:
            figure = Figure(f"{name}#/absolute/all/{key}", measure, found[key], "m", description)
            yield _reported("DQ_AbsoluteExternalPositionalAccuracy", figure, "directExternal")
    if found.get("n") is not None:
        figure = Figure(f"{name}#/absolute/all/n", "number of cells compared", found["n"])
        yield _reported("DQ_AbsoluteExternalPositionalAccuracy", figure, "directExternal")
    at_points = evaluation.get("asprs") or {}
    for kind, ground in POINT_KINDS.items():
        for key, (measure, unit) in POINT_ACCURACY.items():
            value = (at_points.get(kind) or {}).get(key)
            if value is not None:
                what = f"{measure}, {ground} points"
                figure = Figure(f"{name}#/asprs/{kind}/{key}", what, value, unit, at_points["standard"])
                yield _reported("DQ_AbsoluteExternalPositionalAccuracy", figure, "directExternal")


def sigma_figures(run: Mapping[str, Any]) -> Iterator[Figure]:
    """Standard deviations of the heights, as sigma.tif has them."""
    for key, name in SIGMA.items():
        if run["sigma"].get(key) is not None:
            yield Figure(f"{RECORD}#/sigma/{key}", name, run["sigma"][key], "m", "As sigma.tif estimates them.")
    yield Figure(f"{RECORD}#/sigma/cells", "number of cells with a standard deviation", run["sigma"]["cells"])


def tie_figures(run: Mapping[str, Any]) -> Iterator[Figure]:
    """How well the cameras agree at the tie points, image by image."""
    for view, entry in run["orientation"]["views"].items():
        after = (entry.get("residual_after_px") or {}).get("rms")
        if after is not None:
            pointer = f"{RECORD}#/orientation/views/{_escaped(view)}/residual_after_px/rms"
            yield Figure(pointer, f"root mean square residual of the tie points in image {view}", after, "px")


def completeness_figures(run: Mapping[str, Any]) -> Iterator[Figure]:
    """The coverage, counts of cells, and counts of empty cells by their reason."""
    said = "Share of the cells seen by two images or more, without levelled water, whose height was matched."
    yield Figure(f"{RECORD}#/coverage", "coverage", run["coverage"], "", said)
    for key, name in COUNTS.items():
        yield Figure(f"{RECORD}#/cells/{key}", name, run["cells"][key])
    for flag, n in run["cells"]["empty"].items():
        yield Figure(f"{RECORD}#/cells/empty/{flag}", f"empty cells: {flag}", n, "", "By the first of its reasons.")


def _escaped(key: str) -> str:
    """A key in a JSON pointer. Source: RFC 6901, section 3."""
    return key.replace("~", "~0").replace("/", "~1")


def _reported(kind: str, figure: Figure, method: str) -> Element:
    """A quality element with one result. kind : of ISO 19157, without prefix; method : how it was evaluated."""
    methods = {"indirect": "indirect", "direct": "directInternal", "directExternal": "directExternal"}
    described = text("mdq:measureDescription", figure.description) if figure.description else None
    measure = element(
        "mdq:DQ_MeasureReference", identifier("mdq:measureIdentification", figure.pointer),
        text("mdq:nameOfMeasure", figure.name), described,
    )  # fmt: skip
    evaluated = element(
        "mdq:DQ_EvaluationMethod", code("mdq:evaluationMethodType", "mdq:DQ_EvaluationMethodTypeCode", methods[method])
    )
    unit = element("mdq:valueUnit", xlink_href=UNITS[figure.unit]) if figure.unit else None
    result = element("mdq:DQ_QuantitativeResult", number("mdq:value", figure.value, "gco:Record"), unit)
    return element(
        f"mdq:{kind}", element("mdq:measure", measure), element("mdq:evaluationMethod", evaluated),
        element("mdq:result", result),
    )  # fmt: skip


def _lineage(run: Mapping[str, Any]) -> Element:
    """Inputs with their checksums, and what was done with them when, by which version."""
    statement = (
        f"Made by `{run['command']}` with zlocus {run['versions']['zlocus']} on a processor of kind "
        f"{run['processor']}; request, options and versions of all libraries are in {RECORD}."
    )
    scope = element("mrl:scope", element("mcc:MD_Scope", _code_of_scope("mcc:level")))
    sources = [element("mrl:source", _source(each)) for each in run["inputs"]]
    views = [element("mrl:source", _view(name, entry, run)) for name, entry in run["orientation"]["views"].items()]
    steps = [element("mrl:processStep", step) for step in (*_stages(run), *_redone(run))]
    return element("mrl:LI_Lineage", text("mrl:statement", statement), scope, *sources, *views, *steps)


def _source(record: Mapping[str, Any]) -> Element:
    """An input file."""
    digest = record.get("sha256")
    known_by = None if digest is None else identifier("cit:identifier", digest, "SHA-256")
    named = citation("mrl:sourceCitation", str(record["path"]), known_by)
    return element("mrl:LI_Source", text("mrl:description", "Input file"), named)


def _view(name: str, entry: Mapping[str, Any], run: Mapping[str, Any]) -> Element:
    """An image with its camera and the correction that it got."""
    facts = [f"sensor {entry.get('sensor')}", f"{entry.get('n_ties')} tie points"]
    if (shift := entry.get("shift_px")) is not None:
        facts.append(f"corrected by {shift[0]} px across and {shift[1]} px down")
    if after := entry.get("residual_after_px"):
        facts.append(f"residual {after.get('rms')} px (root mean square)")
    taken = run.get("acquisitions", {}).get(name, {})
    facts += [f"{key} {taken[key]}" for key in ("satellite", "time", "cloud_cover") if taken.get(key) is not None]
    return element(
        "mrl:LI_Source", text("mrl:description", f"Image and camera: {', '.join(facts)}."),
        citation("mrl:sourceCitation", name),
    )  # fmt: skip


def _stages(run: Mapping[str, Any]) -> Iterator[Element]:
    """The stages of the run with their times."""
    for place, stage in enumerate(run["stages"]):
        said = f"{stage['name']}: {stage['wall_s']} s, {stage['cpu_s']} s of processors, at most {stage['peak_mb']} MB"
        if stage["name"] == "orient":
            orientation = run["orientation"]
            said += f"; model {orientation['model']}, {orientation['n_ties']} tie points"
        yield _step(f"{said}.", str(run["created"]), f"stage-{place}", str(run["versions"]["zlocus"]))


def _redone(run: Mapping[str, Any]) -> Iterator[Element]:
    """The parts that were redone since."""
    for place, entry in enumerate(run.get("redone", [])):
        area = entry["area"][0]
        differing = [f"{name} = {value['is']}" for name, value in entry["options"].items()]
        how = ", ".join(differing) or "the options of the run"
        if entry["level"] is not None:
            how = f"the level {entry['level']}"
        said = (
            f"A part was redone inside {area['path']} (SHA-256 {area['sha256']}), with {how}: {entry['cells_changed']} "
            f"of {entry['cells_inside']} cells changed."
        )
        yield _step(said, str(entry["time"]), f"redone-{place}", str(entry["versions"]["zlocus"]))


def _step(description: str, when: str, number_of: str, version: str) -> Element:
    return element(
        "mrl:LI_ProcessStep", text("mrl:description", description), instant("mrl:stepDateTime", when, number_of),
        citation("mrl:reference", "zlocus", text("cit:edition", version)),
    )  # fmt: skip
