"""Rasters of classes that GDAL makes of another raster when they are read (VRT), with names and colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from zlocus.io.open_raster import open_raster
from zlocus.io.styles.layer_style import ValueColour, number
from zlocus.io.styles.xml_nodes import document, node


def class_raster(source: Path, classes: Sequence[ValueColour], class_of_value: Mapping[int, int]) -> str:
    """The text of a raster whose cells hold the class of the values of another one, in the same folder.

    classes : their values are 0, 1, 2 ... in this order; class_of_value : of every value that occurs.

    Raises
    ------
    InputError
        The other raster is missing or damaged.
    """
    with open_raster(source, "raster") as file:
        rows, cols, crs, transform = file.height, file.width, file.crs, file.transform.to_gdal()
    table = ",".join(f"{value}:{class_of_value[value]}" for value in sorted(class_of_value))
    colours = (
        node("Entry", **{f"c{k}": str(part) for k, part in enumerate((*each.colour, 255), 1)}) for each in classes
    )
    band = node(
        "VRTRasterBand", node("ColorInterp", text="Palette"), node("ColorTable", *colours),
        node("CategoryNames", *(node("Category", text=each.label) for each in classes)),
        node(
            "ComplexSource", node("SourceFilename", text=source.name, relativeToVRT="1"),
            node("SourceBand", text="1"), node("LUT", text=table),
        ),
        dataType="Byte", band="1",
    )  # fmt: skip
    placed = [
        None if crs is None else node("SRS", text=crs.to_wkt(), dataAxisToSRSAxisMapping="1,2"),
        node("GeoTransform", text=", ".join(number(value) for value in transform)),
    ]
    root = node("VRTDataset", *placed, band, rasterXSize=str(cols), rasterYSize=str(rows))
    return document(root, has_declaration=False)
