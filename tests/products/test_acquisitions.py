from __future__ import annotations

import datetime
import json
from pathlib import Path

from zlocus.core.scene import Acquisition, SunDirection, View
from zlocus.products.acquisitions import acquisition_records, acquisition_rows

TIME = datetime.datetime(2014, 10, 5, 16, 1, 38, 250_000, datetime.UTC)
WHOLE = Acquisition(TIME.date(), TIME, "WV03", SunDirection(158.4, 51.2), 212.0, 19.5, 17.5, 0.254)


def view(name, acquisition):
    return View(name, Path(name), None, None, acquisition=acquisition)  # type: ignore[arg-type]


def test_records_and_rows_say_what_is_known():
    views = [
        view("a", WHOLE), view("b", Acquisition()), view("c", Acquisition(date=TIME.date())),
        view("d", Acquisition(off_nadir_deg=4.4)),
    ]  # fmt: skip
    records = acquisition_records(views)
    assert json.loads(json.dumps(records)) == records
    assert acquisition_rows(records) == [
        ("a", "2014-10-05 16:01:38", "WV03", "azimuth 158°, 51° up", "azimuth 212°, 20° off the vertical", "25 %"),
        ("c", "2014-10-05", "-", "-", "-", "-"),
        ("d", "-", "-", "-", "4° off nadir", "-"),
    ]


def test_the_page_of_the_doctor_explains_both_angles():
    page = Path(__file__).parents[2].joinpath("docs", "how-to", "doctor.md").read_text(encoding="utf-8")
    assert "*Off the vertical* is the incidence" in page
    assert "*Off nadir* is the angle at the satellite" in page
