"""The printed table: absolute and aligned figures side by side, in lines that a terminal shows."""

from __future__ import annotations

import math

from zlocus.evaluation.accuracy import Accuracy
from zlocus.evaluation.evaluate import Evaluation
from zlocus.evaluation.mvs3dm import Mvs3dm
from zlocus.evaluation.shift import Shift
from zlocus.evaluation.statistics import ErrorStatistics
from zlocus.evaluation.table import KINDS, accuracy_table, evaluation_table, main_figures_line

MAX_LINE = 100


def accuracy(error_m, thresholds=(1.0,), n=1_234_567):
    shares = tuple((limit, 0.9) for limit in thresholds)
    statistics = ErrorStatistics(n, 1.0, 0.9, -error_m, error_m, 2 * error_m, 3 * error_m, 4 * error_m, shares=shares)
    groups = ("0-5", "5-15", "15-30", "30-45", "45-90", "unknown")
    return Accuracy(
        statistics, dict.fromkeys(("ground", "building", "tree"), statistics), dict.fromkeys(groups, statistics),
        Mvs3dm(0.9, error_m),
    )  # fmt: skip


def evaluation(**changes):
    values = {
        "absolute_accuracy": accuracy(2.5),
        "threshold_m": 1.0,
        "aligned_accuracy": accuracy(0.25),
        "found_shift": SHIFT,
    }
    return Evaluation(**values | changes)


SHIFT = Shift(0.7, -1.2, 0.4)


def test_each_group_has_its_absolute_and_its_aligned_figures_in_one_line():
    lines = evaluation_table(evaluation()).splitlines()
    assert lines[0].split() == list(KINDS)
    assert lines[1].split() == ["cells", "complete", *["within", "median", "NMAD", "RMSE", "LE90"] * 2]
    by_name = {line.split()[0]: line.split() for line in lines[2:12]}
    assert list(by_name) == ["all", "ground", "building", "tree", "0-5", "5-15", "15-30", "30-45", "45-90", "slope"]
    figures = ["90.00", "%", "-2.500", "2.500", "5.000", "7.500", "90.00", "%", "-0.250", "0.250", "0.500", "0.750"]
    for name in ("all", "ground", "building", "tree"):
        assert by_name[name][1:] == ["1234567", "100.00", "%", *figures]
    # The two words stand above the columns that they name.
    columns = lines[1].index("within"), lines[1].rindex("within")
    assert columns[0] < lines[0].index("absolute") < columns[1] < lines[0].index("aligned")
    assert "absolute: the surface as it lies" in lines
    assert "aligned: removed first: +0.700 m east, -1.200 m north, +0.400 m up" in lines


def test_no_line_is_longer_than_a_terminal():
    height_alone = Shift(0, 0, -30.2, undetermined="4 m more in some direction raise the spread by less than 5 %")
    changed = (
        {}, {"found_shift": height_alone},
        {"absolute_accuracy": accuracy(2.5, (1.0, 0.5, 0.25)), "aligned_accuracy": accuracy(0.25, (1.0, 0.5, 0.25))},
    )  # fmt: skip
    for changes in changed:
        lines = evaluation_table(evaluation(**changes)).splitlines()
        assert max(map(len, lines)) <= MAX_LINE, max(lines, key=len)


def test_what_is_not_known_is_a_dash_and_a_reason():
    lines = evaluation_table(
        evaluation(aligned_accuracy=None, found_shift=None, no_shift="the moon is full")
    ).splitlines()
    assert lines[2].split()[-5:] == ["-"] * 5
    assert "aligned: there are no figures, because the moon is full" in lines
    assert not any(line.startswith("MVS3DM, aligned") for line in lines)


def test_a_height_alone_is_said_to_be_removed_alone():
    lines = evaluation_table(evaluation(found_shift=Shift(0, 0, 0.4, undetermined="it is dark"))).splitlines()
    at = lines.index("aligned: removed first: +0.400 m up alone")
    assert lines[at + 1] == "the horizontal shift is not determined: it is dark"


def test_several_thresholds_have_a_table_of_their_own():
    thresholds = (1.0, 0.5, 0.25)
    found = evaluation(absolute_accuracy=accuracy(2.5, thresholds), aligned_accuracy=accuracy(0.25, thresholds))
    main, several = (part.splitlines() for part in evaluation_table(found).split("\n\n"))
    assert main[1].split() == ["cells", "complete", *["<", "1", "m", "median", "NMAD", "RMSE", "LE90"] * 2]
    assert several[1].split() == ["cells", "complete", *["<", "1", "m", "<", "0.5", "m", "<", "0.25", "m"] * 2]
    assert several[2].split() == ["all", "1234567", "100.00", "%", *["90.00", "%"] * 6]


def test_a_table_of_all_figures_has_every_threshold_and_error():
    table = accuracy_table(evaluation())
    assert table.kind_headings == ("within", "median", "NMAD", "RMSE", "LE90", "LE95")
    assert table.rows[0] == (
        ("all", "1234567", "100.00 %"),
        ("90.00 %", "-2.500", "2.500", "5.000", "7.500", "10.000"),
        ("90.00 %", "-0.250", "0.250", "0.500", "0.750", "1.000"),
    )


def test_a_median_of_nearly_nothing_has_no_sign():
    found = evaluation(aligned_accuracy=accuracy(1e-5), found_shift=Shift(-1e-5, 0.0, -1e-5))
    text = evaluation_table(found)
    assert "-0.000" not in text
    assert math.isclose(found.aligned_accuracy.statistics.median, -1e-5)


def test_a_share_of_all_but_one_cell_is_not_all():
    nearly, hardly = ErrorStatistics(10**6, 1 - 1e-6, 1e-6, *[0.1] * 5), ErrorStatistics(9, 1.0, 0.0, *[0.1] * 5)
    for statistics, complete, within in ((nearly, "> 99.99 %", "< 0.01 %"), (hardly, "100.00 %", "0.00 %")):
        (row, *_) = accuracy_table(evaluation(absolute_accuracy=Accuracy(statistics))).rows
        assert (row[0][2], row[1][0]) == (complete, within)


def test_the_main_figures_are_named():
    assert main_figures_line(evaluation()).endswith("--align or --coregister makes them the aligned ones")
    assert main_figures_line(evaluation(is_aligned=True)).endswith("the aligned ones, because of --align")
    fitted = Shift(0.7, -1.2, 0.4, "nuth-kaab", 4, 0.01)
    line = main_figures_line(evaluation(is_aligned=True, found_shift=fitted))
    assert line.endswith("the aligned ones, because of --coregister nuth-kaab")


def test_figures_and_bands_that_need_words_have_them():
    lines = evaluation_table(evaluation()).splitlines()
    assert "MVS3DM: as that benchmark counts, single cells within 1 m, and the median of absolute errors" in lines
    assert any(
        line.startswith("slope unknown: a neighbour of the cell has no height in the reference") for line in lines
    )
