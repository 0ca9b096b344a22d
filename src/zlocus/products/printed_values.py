"""Values that Ji et al. (2014) print, to stand beside those of a run, and their rules in figures.

Their ADS40 images (Waldkirch; reference image N1, search images B1, F1, B2, N2, F2) are not available, so no run can
reproduce the numbers. The rules can be tested all the same: from the printed rho1 and rho2 our code must find the
printed ratios, labels and order.
"""

from __future__ import annotations

from typing import NamedTuple


class PrintedCurve(NamedTuple):
    """rho1, rho2, their ratio (absolute value) and the label of a match curve, as printed."""

    rho1: float
    rho2: float
    ratio: float
    label: int


SEARCH_IMAGES = ("b1", "f1", "b2", "n2", "f2")
# Table 3: match curves of three feature points against the search images.
TABLE_3 = {
    ("P1", "b1"): PrintedCurve(0.9083, 0.7142, 1.2718, 1),
    ("P1", "f1"): PrintedCurve(0.7801, 0.7387, 1.0560, 0),
    ("P1", "b2"): PrintedCurve(0.7683, 0.4412, 1.7413, 1),
    ("P1", "n2"): PrintedCurve(0.6771, 0.5306, 1.2761, 0),
    ("P1", "f2"): PrintedCurve(0.7670, 0.5769, 1.3295, 0),
    ("P2", "b1"): PrintedCurve(0.9572, -0.2432, 3.9359, 1),
    ("P2", "f1"): PrintedCurve(0.8887, 0.5691, 1.5616, 1),
    ("P2", "b2"): PrintedCurve(0.9435, 0.1500, 6.2900, 1),
    ("P2", "n2"): PrintedCurve(0.8725, 0.3719, 2.3461, 1),
    ("P2", "f2"): PrintedCurve(0.9692, 0.4467, 2.1697, 1),
    ("P3", "b1"): PrintedCurve(0.7628, 0.5539, 1.3771, 0),
    ("P3", "f1"): PrintedCurve(0.6557, 0.2668, 2.4576, 1),
    ("P3", "b2"): PrintedCurve(0.3989, 0.3259, 1.2240, -1),
    ("P3", "n2"): PrintedCurve(0.2977, 0.2208, 1.3483, -1),
    ("P3", "f2"): PrintedCurve(0.3293, 0.3210, 1.0259, -1),
}
# Table 4: labels accumulated over the three points, and the groups {B1, F1}, {B2}, {N2, F2} of the order.
TABLE_4 = {"b1": 2, "f1": 2, "b2": 1, "n2": 0, "f2": 0}
PRINTED_GROUPS = (("b1", "f1"), ("b2",), ("n2", "f2"))
# Figure 6: mean curve of P0 with B1 and F1.
FIGURE_6 = PrintedCurve(0.7322, 0.1618, 4.5253, 1)
