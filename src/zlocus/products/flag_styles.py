"""The values of quality.tif with their names and colours: style, attribute table, and a raster of their groups."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zlocus.io.row_strips import BandReader, strips_of
from zlocus.io.styles.attribute_table import TableRow, attribute_table
from zlocus.io.styles.class_raster import class_raster
from zlocus.io.styles.layer_style import ClassStyle, ValueColour
from zlocus.matching.quality import flags_of, is_empty
from zlocus.products.report.maps import FLAG_GROUPS, NO_FLAG, groups_of

N_CODES = 1 << 16
# Names and colours of the groups in which the report counts cells; the last one is that of cells without a flag.
GROUPS = (*((name, colour) for name, _, colour in FLAG_GROUPS), NO_FLAG)


@dataclass(frozen=True, eq=False)
class FlagValues:
    """The values that occur in a quality.tif. path : of the raster; counts : (65536,) int64, cells with each value."""

    path: Path
    counts: NDArray[np.int64]

    @classmethod
    def of(cls, path: Path) -> FlagValues:
        """Count the values of a raster, strip by strip.

        Raises
        ------
        InputError
            It is missing or damaged.
        """
        counts = np.zeros(N_CODES, np.int64)
        with BandReader(path) as reader:
            for strip in strips_of(reader.geobox.shape[0]):
                counts += np.bincount(reader.read(strip).ravel(), minlength=N_CODES)
        return cls(path, counts)

    def codes(self) -> list[int]:
        """The values, group after group as the report lists them, and in each the frequent ones first."""
        codes = np.flatnonzero(self.counts)
        order = np.lexsort((codes, -self.counts[codes], groups_of(codes)))
        return [int(code) for code in codes[order]]

    def style(self) -> ClassStyle:
        """Each value with the names of its flags, in the colour of its group."""
        return ClassStyle(tuple(_colour_of(code) for code in self.codes()))

    def table(self) -> str:
        """The attribute table: a row for each value with its flags by name, its number of cells, whether such cells
        have a height, and the group."""
        rows = []
        for code in self.codes():
            has_height = int(not is_empty(np.array([code], np.uint16))[0])
            rows.append(TableRow(_colour_of(code), int(self.counts[code]), (has_height, GROUPS[_group_of(code)][0])))
        return attribute_table(rows, ("HasHeight", "Group"))

    def reasons(self) -> str:
        """The raster of the groups, which GDAL makes of this one when it is read."""
        classes = [ValueColour(k, colour, name) for k, (name, colour) in enumerate(GROUPS)]
        # GDAL interpolates between values, so those at both ends are given too.
        codes = {0, N_CODES - 1, *self.codes()}
        return class_raster(self.path, classes, {code: _group_of(code) for code in codes})


def _group_of(code: int) -> int:
    return int(groups_of(np.array([code]))[0])


def _colour_of(code: int) -> ValueColour:
    names = ", ".join(str(flag.name) for flag in flags_of(code)) if code else NO_FLAG[0]
    return ValueColour(code, GROUPS[_group_of(code)][1], names)
