"""Tables of the report: images, pairs, labels, stages, options."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import InputError
from zlocus.core.options import RunConfig
from zlocus.matching.match_curve import FAIR, GOOD, POOR
from zlocus.products.report.text import NONE, STAGES, number, percent, seconds, whole_percent
from zlocus.products.tie_layers import LABEL, LABELS, TEXT, column_names, labels_in

# Colours of poor and good matches; blue and orange can be distinguished by colour-blind readers.
POOR_COLOUR, GOOD_COLOUR = np.array([230, 159, 0]), np.array([86, 180, 233])
MAX_MATRIX_IMAGES = 60
# Width of a letter in a matrix, padding of a column, and minimum number of letters in a column.
LETTER_PX, PADDING_PX, MIN_LETTERS = 9, 16, 5
# Narrowest page, and page widths below which the style shows a hint to scroll; the last stands for any width.
NARROWEST_PX, PAGES_PX = 360, (400, 600, 700, 1100, 9999)


@dataclass(frozen=True)
class ImageRow:
    """Residuals of an image's ties before and after the orientation.

    before, after : median, rms and 90th percentile; bars : widths of both medians, percent.
    """

    number: int
    name: str
    sensor: str
    n_ties: int
    shift: str
    before: tuple[str, str, str]
    after: tuple[str, str, str]
    bars: tuple[float, float]


@dataclass(frozen=True)
class MatrixCell:
    """A cell of a matrix. colour : CSS, "" for none; title : its meaning in words."""

    text: str
    colour: str = ""
    title: str = ""


@dataclass(frozen=True)
class Matrix:
    """A matrix with a row and a column for every name."""

    names: tuple[str, ...]
    cell_rows: tuple[tuple[MatrixCell, ...], ...]

    @property
    def wider_than(self) -> int:
        """Page width of `PAGES_PX` up to which the matrix is wider than the page, about; 0 where it always fits."""
        lengths = [max(len(name), MIN_LETTERS) for name in self.names]
        width = LETTER_PX * (sum(lengths) + max(lengths)) + PADDING_PX * (len(lengths) + 2)
        return 0 if width <= NARROWEST_PX else min(page for page in PAGES_PX if page >= width or page == PAGES_PX[-1])


@dataclass(frozen=True)
class StageRow:
    """Time and memory of a stage. bar : share of the wall time, percent."""

    name: str
    does: str
    wall: str
    cpu: str
    peak: str
    bar: float


@dataclass(frozen=True)
class OptionRow:
    """An option, its value, its default where that differs, and its meaning."""

    name: str
    value: str
    default: str
    meaning: str


def image_rows(views: Mapping[str, Mapping[str, Any]]) -> list[ImageRow]:
    """Residuals of all images, from `orientation.views` of run.json."""
    widest = max(
        (view[key]["median"] or 0.0 for view in views.values() for key in ("residual_before_px", "residual_after_px")),
        default=0.0,
    )
    rows = []
    for i, (name, view) in enumerate(views.items(), 1):
        before, after = view["residual_before_px"], view["residual_after_px"]
        bars = tuple(100 * (each["median"] or 0.0) / (widest or 1.0) for each in (before, after))
        # Adding 0 turns -0 into 0.
        shift = ", ".join(f"{round(value, 2) + 0.0:+.2f}" for value in view["shift_px"])
        row = ImageRow(
            i, name, view["sensor"], view["n_ties"], shift, _residuals(before), _residuals(after), (bars[0], bars[1])
        )
        rows.append(row)
    return rows


def _residuals(residuals: Mapping[str, float | None]) -> tuple[str, str, str]:
    median, rms, percent90 = (number(residuals[key], "", 3) for key in ("median", "rms", "percent90"))
    return median, rms, percent90


def pair_matrix(
    names: Sequence[str], pairs: Sequence[Mapping[str, Any]], overlaps: Sequence[Mapping[str, Any]]
) -> Matrix:
    """Matrix with the base-to-height ratio above the diagonal, and below it the distance of ties from their loci, px.

    pairs : of run.json's orientation, from which the distances after orientation come; overlaps : of
    footprints.geojson.
    """
    place = {name: i for i, name in enumerate(names)}
    cells = [[MatrixCell(NONE, title=f"{a} and {b}: not known") for b in names] for a in names]
    for i in range(len(names)):
        cells[i][i] = MatrixCell("", "#dddddd")
    for overlap in overlaps:
        i, j = sorted(place[name] for name in overlap["views"])
        says = f"{names[i]} and {names[j]}: base-to-height {number(overlap['base_to_height'])}, "
        says += f"{percent(overlap['overlap'] or 0.0, 1.0)} of the smaller footprint shared"
        cells[i][j] = MatrixCell(number(overlap["base_to_height"]), title=says)
    for pair in pairs:
        i, j = sorted(place[name] for name in pair["views"])
        before, after = (number(pair[f"epipolar_distance_{when}_px"], "px", 3) for when in ("before", "after"))
        says = f"{names[i]} and {names[j]}: {pair['n_ties']} ties, off by {before} before and {after} after"
        cells[j][i] = MatrixCell(number(pair["epipolar_distance_after_px"], "", 3), title=says)
    return Matrix(tuple(names), tuple(tuple(row) for row in cells))


def label_matrix(path: Path, names: Sequence[str]) -> Matrix | None:
    """Share of tie points with a good match curve, for each reference image (row) and search image (column).

    None where there is no ranking, or where it is of other images.
    """
    if not path.exists():
        return None
    import pyogrio.raw  # takes a quarter of a second
    from pyogrio.errors import DataLayerError, DataSourceError

    try:
        meta, _, _, columns = pyogrio.raw.read(path, layer="ranking", read_geometry=False)
    except (DataSourceError, DataLayerError) as error:
        raise InputError(f"{path} cannot be read: {error}. Make the surface again.") from error
    held = dict(zip((str(name) for name in meta["fields"]), columns, strict=True))
    counts = _counts_of_texts(held, names) if TEXT in held else _counts_of_columns(held, names)
    if counts is None:
        return None
    rows = (tuple(_label_cell(a, b, counts[i, j].tolist()) for j, b in enumerate(names)) for i, a in enumerate(names))
    return Matrix(tuple(names), tuple(rows))


def _counts_of_columns(held: Mapping[str, Any], names: Sequence[str]) -> NDArray[np.int64] | None:
    """Counts (i, i, 3) of the labels of a search image (second axis) against the reference; None for other images."""
    columns = column_names(names)
    if set(columns) != {name for name in held if name.startswith(LABEL)}:
        return None
    counts = np.zeros((len(names), len(names), len(LABELS)), np.int64)
    for i, reference in enumerate(names):
        mine = held["reference"] == reference
        for j, column in enumerate(columns):
            counts[i, j] = [(held[column][mine] == label).sum() for label in (GOOD, FAIR, POOR)]
    return counts


def _counts_of_texts(held: Mapping[str, Any], names: Sequence[str]) -> NDArray[np.int64] | None:
    """Counts as of `_counts_of_columns`, where labels are texts."""
    place = {name.replace(",", " "): i for i, name in enumerate(names)}
    counts = np.zeros((len(names), len(names), len(LABELS)), np.int64)
    for reference, text in zip(held["reference"], held[TEXT], strict=True):
        for name, label in labels_in(text).items():
            i, j = place.get(reference.replace(",", " ")), place.get(name)
            if i is None or j is None or label not in (GOOD, FAIR, POOR):
                return None
            counts[i, j, (GOOD, FAIR, POOR).index(label)] += 1
    return counts


def sampled_matrix(pairs: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Matrix | None:
    """Matrix as of `label_matrix`, from the sample of a run that ranked no images; None where it is of other images.

    pairs : of curves.json, with the labels of each pair, in either order.
    """
    place = {name: i for i, name in enumerate(names)}
    counts = np.zeros((len(names), len(names), len(LABELS)), int)
    for pair in pairs:
        if not set(pair["images"]) <= set(names):
            return None
        i, j = (place[name] for name in pair["images"])
        counts[i, j] = counts[j, i] = [pair[label] for label in LABELS]
    rows = (tuple(_label_cell(a, b, counts[i, j].tolist()) for j, b in enumerate(names)) for i, a in enumerate(names))
    return Matrix(tuple(names), tuple(rows))


def _label_cell(reference: str, search: str, counts: Sequence[int]) -> MatrixCell:
    """Cell for the labels of a search image against a reference image. counts : of good, fair and poor labels."""
    if reference == search:
        return MatrixCell("", "#dddddd")
    total = sum(counts)
    if not total:
        return MatrixCell(NONE, title=f"{search} was never compared with {reference}")
    good, fair, poor = (percent(n, total) for n in counts)
    mean = (counts[0] - counts[2]) / total
    end = GOOD_COLOUR if mean > 0 else POOR_COLOUR
    colour = np.rint(255 + abs(mean) * (end - 255)).astype(int)
    says = f"{search} against {reference}: good at {good}, fair at {fair}, poor at {poor} of {total} tie points"
    return MatrixCell(whole_percent(counts[0], total), f"rgb({colour[0]},{colour[1]},{colour[2]})", says)


def stage_rows(stages: Sequence[Mapping[str, Any]]) -> list[StageRow]:
    """Time and memory of each stage, and of all stages."""
    total = sum(stage["wall_s"] for stage in stages)
    rows = [
        StageRow(
            stage["name"], STAGES.get(stage["name"], ""), seconds(stage["wall_s"]), seconds(stage["cpu_s"]),
            f"{stage['peak_mb']:.0f} MB", 100 * stage["wall_s"] / total if total else 0.0,
        )
        for stage in stages
    ]  # fmt: skip
    cpu, peak = sum(stage["cpu_s"] for stage in stages), max((stage["peak_mb"] for stage in stages), default=0.0)
    return [*rows, StageRow("all", "", seconds(total), seconds(cpu), f"{peak:.0f} MB", 100.0)]


def request_rows(request: Mapping[str, Any]) -> list[OptionRow]:
    """The request: arguments and options of the command line."""
    return [OptionRow(name, plain(value), "", "") for name, value in request.items()]


def option_rows(options: Mapping[str, Any]) -> list[OptionRow]:
    """Every option of every stage with its meaning and, where the value differs, its default."""
    known = {name: (default, meaning) for name, default, meaning in known_options()}
    rows = []
    for name, value in nested_values(options):
        default, meaning = known.get(name, (value, ""))
        rows.append(OptionRow(name, plain(value), "" if default == value else plain(default), meaning))
    return rows


def nested_values(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of a nested table, by names with points between them."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from nested_values(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def known_options() -> Iterator[tuple[str, Any, str]]:
    """Yield name, default and meaning of every option of every stage."""
    return _known(RunConfig())


def _known(options: Any, prefix: str = "") -> Iterator[tuple[str, Any, str]]:
    """Yield name, default and meaning of every option."""
    for f in fields(options):
        value = getattr(options, f.name)
        if is_dataclass(value):
            yield from _known(value, f"{prefix}{f.name}.")
        else:
            unit = f" [{f.metadata['unit']}]" if f.metadata.get("unit") else ""
            yield prefix + f.name, list(value) if isinstance(value, tuple) else value, f.metadata["doc"] + unit


def plain(value: Any) -> str:
    """A value of an option in words."""
    if value is None:
        return "not given"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
