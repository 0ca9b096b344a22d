"""Curves of a place as they are drawn: what `mean_figure` needs, kept in curves.json and read back from there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from zlocus.sensors.model import FloatArray

if TYPE_CHECKING:
    from zlocus.products.curves import PointReport

# Correlations are drawn some hundred pixels high.
DECIMALS = 4


@dataclass(frozen=True)
class MeanCurves:
    """NCC of the first n search images and the means on the way to all of them.

    heights_m : (h,); start_m : the height that the curves began with; names : of the n images; n_search : of all there
    are; values, means : (n, h), NaN where images share nothing; n_used : images whose mean was needed; peak : index of
    the height at which the mean of n is largest, rho1 that mean, ratio over its rival, label its quality.
    """

    reference: str
    names: tuple[str, ...]
    n_search: int
    n_used: int
    heights_m: FloatArray
    start_m: float
    values: FloatArray
    means: FloatArray
    peak: int
    rho1: float
    ratio: float
    label: int

    @classmethod
    def of(cls, report: PointReport, n: int) -> MeanCurves:
        """The first n images of a place."""
        curves, mean = report.curves, report.curves.mean
        peaks = mean.peaks
        return cls(
            report.reference, tuple(report.search[:n]), len(report.search), curves.n_used,
            np.asarray(report.heights_m, float), float(report.xyz[2]),
            np.asarray(curves.single.values[:n], float), np.asarray(mean.values[:n], float),
            int(peaks.peak[n - 1]), float(peaks.rho1[n - 1]), float(peaks.ratio[n - 1]), int(mean.labels[n - 1]),
        )  # fmt: skip

    def record(self) -> dict[str, Any]:
        """What curves.json keeps beside `point_record`, which says the rest; what is not finite becomes null."""
        return {
            "first_m": float(self.heights_m[0]), "last_m": float(self.heights_m[-1]), "peak": self.peak,
            "values": self.values.round(DECIMALS).tolist(), "means": self.means.round(DECIMALS).tolist(),
        }  # fmt: skip

    @classmethod
    def read(cls, cell: Mapping[str, Any]) -> MeanCurves:
        """Of a cell of curves.json."""
        point, drawn, n = cell["point"], cell["drawn"], cell["n_shown"]
        values, means = (np.array(drawn[name], float).reshape(n, -1) for name in ("values", "means"))
        mean = point["means"][n - 1]
        return cls(
            point["reference"], tuple(curve["image"] for curve in point["curves"][:n]), len(point["means"]),
            point["stop"]["images"], np.linspace(drawn["first_m"], drawn["last_m"], values.shape[1]), point["xyz"][2],
            values, means, drawn["peak"], _number(mean["rho1"]), _number(mean["ratio"]), mean["label"],
        )  # fmt: skip


def _number(value: float | None) -> float:
    """Null is what is not finite."""
    return np.nan if value is None else value
