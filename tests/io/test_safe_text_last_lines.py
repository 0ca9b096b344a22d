"""Last lines without a line end: read where all numbers have the same digits, otherwise refused."""

from __future__ import annotations

import pytest

from zlocus.core.errors import InputError
from zlocus.io.cameras.rpc_text import SCALARS, read_rpc_txt
from zlocus.io.number_table import read_number_table
from zlocus.io.safe_text import digits_written


@pytest.mark.parametrize(
    ("number", "digits"),
    [("12.500", (3, 0)), ("-1.25E-007", (2, 3)), ("+.5e1", (1, 1)), ("12", None), ("12.", None), ("1.2e", None)],
)
def test_how_a_number_is_written(number, digits):
    assert digits_written(number) == digits


def rpc_text(form):
    names = [f"{part}_{kind}_COEFF_{i}" for part in ("LINE", "SAMP") for kind in ("NUM", "DEN") for i in range(1, 21)]
    scalars = [f"{name}: {10.0 + i:.2f}" for i, name in enumerate(SCALARS)]
    return "\n".join([*scalars, *(f"{name}: {1.0 / (i + 1) ** 3:{form}}" for i, name in enumerate(names))])


def test_an_rpc_whose_coefficients_are_written_alike_needs_no_last_line_end(tmp_path):
    path = tmp_path / "img_RPC.TXT"
    path.write_text(rpc_text(".10E"))
    whole = read_rpc_txt(path)
    assert whole.samp_den[-1] == pytest.approx(80.0**-3)
    for cut in range(1, 16):
        path.write_text(rpc_text(".10E")[:-cut])
        with pytest.raises(InputError):
            read_rpc_txt(path)
    path.write_text(rpc_text(".12g"))
    with pytest.raises(InputError, match="stops within line 90"):
        read_rpc_txt(path)


def test_a_table_whose_last_column_is_written_alike_needs_none_either(tmp_path):
    path = tmp_path / "table.csv"
    table = "time,x\n0,12.250\n1,7.125\n2,-3.500"
    path.write_text(table)
    assert read_number_table(path, "table", ("time", "x")).columns["x"].tolist() == [12.25, 7.125, -3.5]
    for cut in range(1, 4):
        path.write_text(table[:-cut])
        with pytest.raises(InputError, match="stops within line 4"):
            read_number_table(path, "table", ("time", "x"))
    path.write_text(table.replace("7.125", "7.1"))
    with pytest.raises(InputError, match="stops within line 4"):
        read_number_table(path, "table", ("time", "x"))
    path.write_text("time,x\n0,12\n1,7\n2,35")
    with pytest.raises(InputError, match="stops within line 4"):
        read_number_table(path, "table", ("time", "x"))
