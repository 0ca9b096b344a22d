"""Attribute tables of rasters, which GDAL and QGIS read from `quality.tif.aux.xml`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from zlocus.io.styles.layer_style import ValueColour
from zlocus.io.styles.xml_nodes import document, node

INTEGER, TEXT = "0", "2"
# Uses of a column, as GDAL numbers them: any other one, number of cells, name, value, red, green, blue.
OTHER, COUNT, NAME, VALUE, RED, GREEN, BLUE = "0", "1", "2", "5", "6", "7", "8"


@dataclass(frozen=True)
class TableRow:
    """A value of a raster with its colour and its name; n_cells : how many cells have it; others : of more columns."""

    colour: ValueColour
    n_cells: int
    others: tuple[Any, ...] = ()


def attribute_table(rows: Sequence[TableRow], other_columns: Sequence[str] = ()) -> str:
    """The text of the file: a row for each value, with its name, colour and number of cells.

    other_columns : names of more columns, whose cells are whole numbers or texts.
    """
    numbers = ("Value", INTEGER, VALUE), ("Count", INTEGER, COUNT), ("Name", TEXT, NAME)
    colours = ("Red", INTEGER, RED), ("Green", INTEGER, GREEN), ("Blue", INTEGER, BLUE)
    kinds = [INTEGER if isinstance(value, int) else TEXT for value in (rows[0].others if rows else ())]
    others = [(name, kind, OTHER) for name, kind in zip(other_columns, kinds, strict=bool(rows))]
    columns = [
        node("FieldDefn", node("Name", text=name), node("Type", text=kind), node("Usage", text=use), index=str(k))
        for k, (name, kind, use) in enumerate((*numbers, *colours, *others))
    ]
    cells = [
        node("Row", *(node("F", text=str(value)) for value in _values(row)), index=str(k)) for k, row in enumerate(rows)
    ]
    table = node("GDALRasterAttributeTable", *columns, *cells, tableType="thematic")
    return document(node("PAMDataset", node("PAMRasterBand", table, band="1")), has_declaration=False)


def _values(row: TableRow) -> tuple[Any, ...]:
    colour = row.colour
    return (int(colour.value), row.n_cells, colour.label, *colour.colour, *row.others)
