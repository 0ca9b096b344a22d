"""Peaks and labels of match curves: the cases that Ji et al. 2014 print, the readings of what they leave open."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from reference import selection as plain
from zlocus.core.options import SelectionOptions
from zlocus.matching.match_curve import (
    FAIR,
    GOOD,
    POOR,
    curve_labels,
    curve_peaks,
    peak_ratio,
    quality_labels,
    strict_maxima,
)

OPTIONS = SelectionOptions()
# Ji et al. 2014, table 3: rho1, rho2, ratio and label of three feature points in five search images.
TABLE_3 = [
    (0.9083, 0.7142, 1.2718, 1), (0.7801, 0.7387, 1.0560, 0), (0.7683, 0.4412, 1.7413, 1),
    (0.6771, 0.5306, 1.2761, 0), (0.7670, 0.5769, 1.3295, 0), (0.9572, -0.2432, 3.9359, 1),
    (0.8887, 0.5691, 1.5616, 1), (0.9435, 0.1500, 6.2900, 1), (0.8725, 0.3719, 2.3461, 1),
    (0.9692, 0.4467, 2.1697, 1), (0.7628, 0.5539, 1.3771, 0), (0.6557, 0.2668, 2.4576, 1),
    (0.3989, 0.3259, 1.2240, -1), (0.2977, 0.2208, 1.3483, -1), (0.3293, 0.3210, 1.0259, -1),
]  # fmt: skip
# Correlations are printed to four digits.
ROUNDING = 5e-5
N_HEIGHTS, STEP_PX = 81, 0.5


def curve(*peaks, floor=-0.5, n=N_HEIGHTS):
    """A curve with one-sample peaks (sample, value) on an even floor."""
    values = np.full(n, floor)
    for at, value in peaks:
        values[at] = value
    return values


def labels_of(*curves, step_px=STEP_PX, options=OPTIONS):
    return curve_labels(np.array(curves), step_px, options).tolist()


@pytest.mark.parametrize(("rho1", "rho2", "ratio", "label"), TABLE_3)
def test_printed_cases(rho1, rho2, ratio, label):
    found = peak_ratio(np.array([rho1]), np.array([rho2]), OPTIONS)
    assert found[0] == pytest.approx(ratio, abs=ROUNDING * (1 + ratio) / abs(rho2) + ROUNDING)
    assert quality_labels(np.array([rho1]), found, np.array([False]), OPTIONS) == [label]
    assert labels_of(curve((40, rho1), (60, rho2))) == [label]


def test_the_figures_of_the_selected_mean():
    """Ji et al. 2014, figure 6: rho1 0.7322, rho2 0.1618, ratio 4.5253."""
    peaks = curve_peaks(np.array([curve((40, 0.7322), (55, 0.1618))]), STEP_PX, OPTIONS)
    assert peaks.ratio[0] == pytest.approx(4.5253, abs=2e-3)
    assert labels_of(curve((40, 0.7322), (55, 0.1618))) == [GOOD]


@pytest.mark.parametrize(
    ("rho1", "ratio", "label"),
    [
        (0.901, 1.21, 1), (0.901, 1.19, 0), (0.90, 1.21, 0), (0.901, 1.2, 0), (0.801, 1.41, 1), (0.80, 1.41, 0),
        (0.801, 1.4, 0), (0.651, 1.61, 1), (0.651, 1.6, 0), (0.65, 9.0, 0), (0.65, 1.4, -1), (0.501, 1.41, 0),
        (0.501, 1.4, -1), (0.50, 9.0, -1), (0.50, np.inf, -1), (0.66, 1.0, 0), (np.nan, np.inf, -1), (-0.9, 9.0, -1),
    ],
)  # fmt: skip
def test_every_limit_of_table_1(rho1, ratio, label):
    assert quality_labels(np.array([rho1]), np.array([ratio]), np.array([False]), OPTIONS) == [label]


def test_limits_are_options():
    options = SelectionOptions(rho1_low=0.3, ratio_low=1.1, rho1_fair=0.1, ratio_fair=1.0)
    assert labels_of(curve((40, 0.35), (60, 0.3)), curve((40, 0.2), (60, 0.15)), options=options) == [GOOD, FAIR]
    assert labels_of(curve((40, 0.35), (60, 0.3)), curve((40, 0.2), (60, 0.15))) == [POOR, POOR]


def test_the_second_peak_is_at_least_two_pixels_away():
    near, far = curve((40, 0.95), (43, 0.9)), curve((40, 0.95), (44, 0.9))
    assert labels_of(near, far) == [GOOD, FAIR]
    assert np.isnan(curve_peaks(near[None], STEP_PX, OPTIONS).rho2[0])
    assert np.isinf(curve_peaks(near[None], STEP_PX, OPTIONS).ratio[0])
    # 49 steps are 2 px, though the product is 1.9999999999999998.
    assert labels_of(curve((20, 0.95), (69, 0.9)), curve((20, 0.95), (68, 0.9)), step_px=2 / 49) == [FAIR, GOOD]
    assert labels_of(near, near, step_px=np.array([0.5, 1.0])) == [GOOD, FAIR]


def test_shoulders_and_plateaus_are_no_second_peaks():
    slope = np.linspace(0.95, 0.15, 40)
    assert labels_of(np.r_[slope[::-1], slope]) == [GOOD]
    assert labels_of(curve((40, 0.95), (60, 0.9), (61, 0.9))) == [GOOD]


def test_of_two_equal_peaks_neither_is_distinct():
    peaks = curve_peaks(np.array([curve((20, 0.95), (60, 0.95))]), STEP_PX, OPTIONS)
    assert (peaks.peak[0], peaks.rho2[0], peaks.ratio[0]) == (20, 0.95, 1.0)
    assert labels_of(curve((20, 0.95), (60, 0.95))) == [FAIR]


@pytest.mark.parametrize("at", [0, N_HEIGHTS - 1])
def test_a_peak_at_an_end_is_never_good_and_no_second_peak(at):
    assert labels_of(curve((at, 0.99))) == [FAIR]
    assert labels_of(curve((at, 0.6))) == [FAIR]
    assert labels_of(curve((at, 0.4))) == [POOR]
    assert labels_of(curve((40, 0.95), (at, 0.94))) == [GOOD]


@pytest.mark.parametrize("beside", [-1, 1])
def test_the_visible_part_of_a_curve_has_ends_too(beside):
    at_gap, rival_at_gap = curve((40, 0.99), (41, 0.2), (39, 0.2)), curve((20, 0.95), (40, 0.9))
    at_gap[40 + beside] = rival_at_gap[40 + beside] = np.nan
    assert labels_of(at_gap, rival_at_gap) == [FAIR, GOOD]


def test_a_curve_with_few_visible_heights_is_never_good():
    hidden = curve((60, 0.95))
    hidden[:40] = np.nan
    assert labels_of(hidden) == [GOOD]
    hidden[:42] = np.nan
    assert labels_of(hidden) == [FAIR]
    assert labels_of(hidden, options=SelectionOptions(min_visible_share=0.0)) == [GOOD]


def test_a_curve_without_visible_heights_is_poor():
    unseen = np.full((1, N_HEIGHTS), np.nan)
    peaks = curve_peaks(unseen, STEP_PX, OPTIONS)
    assert np.isnan([peaks.rho1[0], peaks.rho2[0]]).all()
    assert peaks.is_open.all()
    assert labels_of(*unseen) == [POOR]


def test_second_peaks_without_positive_correlation():
    negative, none = curve((40, 0.7), (60, -0.6), floor=-0.9), curve((40, 0.7), (60, 0.0))
    assert labels_of(negative, none) == [FAIR, GOOD]
    assert labels_of(negative, none, options=SelectionOptions(negative_second_peak="infinite")) == [GOOD, GOOD]


@pytest.mark.parametrize("n", [1, 2, 3])
def test_short_curves(n):
    short = np.full((2, n), 0.3)
    short[:, n // 2] = 0.95
    assert curve_labels(short, STEP_PX, OPTIONS).tolist() == [GOOD if n == 3 else FAIR] * 2


def test_no_curves_at_all():
    labels = curve_labels(np.zeros((0, 5)), STEP_PX, OPTIONS)
    assert (labels.shape, labels.dtype) == ((0,), np.int8)
    assert strict_maxima(np.zeros((0, 1))).shape == (0, 1)


# Steps of 1/16 make equal neighbours and equal peaks frequent.
CURVES = arrays.arrays(
    np.float64,
    st.tuples(st.integers(1, 6), st.integers(1, 24)),
    elements=st.one_of(st.integers(-16, 16).map(lambda n: n / 16), st.just(np.nan)),
)


@given(CURVES, st.sampled_from([0.25, 0.5, 1.0]), st.sampled_from(["absolute", "infinite"]))
def test_as_in_plain_loops(curves, step_px, negative_second_peak):
    options = SelectionOptions(negative_second_peak=negative_second_peak)
    peaks = curve_peaks(curves, step_px, options)
    for n, values in enumerate(curves.tolist()):
        rho1, rho2, is_open = plain.peaks(values, step_px, options)
        assert np.array_equal([peaks.rho1[n], peaks.rho2[n]], np.array([rho1, rho2], float), equal_nan=True)
        assert peaks.is_open[n] == is_open
    assert curve_labels(curves, step_px, options).tolist() == [plain.label(c, step_px, options) for c in curves]


@given(CURVES)
def test_a_reversed_range_gives_the_same_label(curves):
    # Of equal peaks the first counts, so leave those out.
    curves = curves + np.arange(curves.shape[1]) * 1e-6
    same = curve_labels(curves[:, ::-1], STEP_PX, OPTIONS)
    np.testing.assert_array_equal(curve_labels(curves, STEP_PX, OPTIONS), same)
    np.testing.assert_array_equal(
        curve_labels(curves.astype(np.float32), STEP_PX, OPTIONS),
        curve_labels(curves.astype(np.float32).astype(np.float64), STEP_PX, OPTIONS),
    )
