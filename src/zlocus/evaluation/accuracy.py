"""Accuracy of a surface: statistics of its errors over all blocks and over groups of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from zlocus.evaluation.mvs3dm import Mvs3dm
from zlocus.evaluation.statistics import ErrorStatistics


@dataclass(frozen=True)
class Accuracy:
    """Statistics of errors, over all blocks and over groups of them.

    statistics : of all blocks. class_statistics : by class, empty where no classes were given. slope_statistics : by
    band of the reference's slope, degrees. mvs3dm : figures by the definitions of that benchmark.
    """

    statistics: ErrorStatistics
    class_statistics: dict[str, ErrorStatistics] = field(default_factory=dict)
    slope_statistics: dict[str, ErrorStatistics] = field(default_factory=dict)
    mvs3dm: Mvs3dm | None = None

    def as_dict(self) -> dict[str, Any]:
        """The accuracy as JSON holds it."""
        return {
            "all": self.statistics.as_dict(),
            "classes": {name: statistics.as_dict() for name, statistics in self.class_statistics.items()},
            "slopes_deg": {name: statistics.as_dict() for name, statistics in self.slope_statistics.items()},
            **self.mvs3dm_record(),
        }

    def mvs3dm_record(self) -> dict[str, float | None]:
        """The figures of MVS3DM as JSON holds them; none where they were not computed."""
        if self.mvs3dm is None:
            return {}
        values = {"completeness": self.mvs3dm.completeness, "median_error": self.mvs3dm.median_error_m}
        return {f"mvs3dm_{name}": None if math.isnan(value) else value for name, value in values.items()}
