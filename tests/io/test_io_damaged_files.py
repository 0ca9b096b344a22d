"""Damaged files of every format: one sentence that names the file, or what the file still says; never a crash, a hang,
a flood of memory, or a wrong camera.

What may come out of a damaged file, beside a `ZlocusError`:

- cut short at any byte, or with a byte order mark, other line ends or blanks at its end: what the whole file says. A
  list that does not tell its length may lack whole lines at its end, and a file of options the keys on them; what is
  left is then what it was.
- one number replaced by another: what the whole file says, but for that number; where the camera is computed from it,
  either the interior or poses change, not both.
- a number replaced by what is no number ("nan", "yes", "0x1F", "12:30"): no other number than before.
- other bytes: finite numbers, for what they say cannot be known.

ZLOCUS_FUZZ_EXAMPLES sets how many damages are tried per format.
"""

from __future__ import annotations

import os
import re
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

import damage as d
from camera_files import NAMES
from damage import Damage
from damage_cases import CASES, Leaves
from damage_outcomes import Good, check_sentence, outcome
from zlocus.core.errors import ZlocusError

EXAMPLES = int(os.environ.get("ZLOCUS_FUZZ_EXAMPLES", "30"))
MAX_NUMBERS = 60
TEXT = [name for name, case in CASES.items() if case.text]
BINARY = [name for name, case in CASES.items() if not case.text]
SAME = 1e-9


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """The undamaged file of a case, with what it says."""
    made: dict[str, Good] = {}

    def of(name):
        if name not in made:
            case = CASES[name]
            path = case.write(tmp_path_factory.mktemp(name))
            made[name] = Good(case, path, path.read_bytes(), case.read(path))
        return made[name]

    return of


def differing(found: Leaves, whole: Leaves) -> dict[tuple, tuple]:
    """Places at which two answers differ, with both values; `None` where one has nothing."""
    places = found.keys() | whole.keys()
    return {at: (found.get(at), whole.get(at)) for at in places if found.get(at) != whole.get(at)}


def numbers(values) -> list[float]:
    return [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]


def check_kept(good: Good, damage: Damage, found: Leaves) -> None:
    """See the docstring of the module."""
    changes = differing(found, good.says)
    assert np.isfinite(numbers(found.values())).all()
    if damage.kind == d.CUT:
        damaged = damage(good.content)
        # Options that end with a closed bracket or quotation are whole too.
        whole = (b"\n", b"\r", b"]", b"}", b'"', b"'")
        assert not changes or (good.case.rows and damaged.rstrip(b" ").endswith(whole)), changes
        if not good.case.defaults:
            lost = {at for at, (value, _) in changes.items() if value is None}
            assert changes.keys() <= lost or good.says.keys() == found.keys(), changes
    elif damage.kind == d.ENCODING and damage.word in d.HARMLESS:
        assert not changes, changes
    elif damage.kind in (d.TOKENS, d.NUMBERS):
        check_one_token(good, damage, changes)


def check_one_token(good: Good, damage: Damage, changes: dict[tuple, tuple]) -> None:
    start, end = damage.place(good.content)
    if "#" in str(damage.word):
        return  # the rest of the line is a comment
    old, new = (good.case.value(text) for text in (good.content[start:end].decode(), str(damage.word)))
    moved = {at: pair for at, pair in changes.items() if len(numbers(pair)) == 2}
    if new is None:
        assert not moved, moved
    elif old is not None and good.case.exact:
        for at, (here, there) in moved.items():
            as_it_is = here == new and there == old
            # Or by its opposite, where the file says how it counts the first pixel.
            by_as_much = abs(abs(here - there) - abs(new - old)) <= SAME * max(abs(new), abs(old), 1.0)
            assert as_it_is or by_as_much, (at, here, there)
    else:
        assert len({str(at[0]).split()[0] for at in moved} & {"pose", "interior"}) < 2, moved


each_text = pytest.mark.parametrize("name", TEXT)
each_binary = pytest.mark.parametrize("name", BINARY)
many = settings(suppress_health_check=list(HealthCheck), max_examples=EXAMPLES)


@each_text
@many
@given(damage=d.text_damage())
def test_damaged_text(good, name, damage):
    found = outcome(good(name), damage(good(name).content))
    if not isinstance(found, str):
        check_kept(good(name), damage, found)


@each_binary
@many
@given(damage=d.binary_damage())
def test_damaged_bytes(good, name, damage):
    found = outcome(good(name), damage(good(name).content))
    if not isinstance(found, str) and damage.kind == d.CUT:
        assert not differing(found, good(name).says)


GRAMMARS = {
    "scene-": "yaml", "config-yaml": "yaml", "eo-interior": "yaml", "config-toml": "toml", "csm": "json",
    "opensfm": "json", "area-geojson": "geojson", "dimap-": "xml", "metashape": "xml", "rpb": "rpb",
}  # fmt: skip


def worst_lines(name):
    """Lines of 10 MB that the format may choke on; all of them where many examples are asked for."""
    grammar = next((found for start, found in GRAMMARS.items() if name.startswith(start)), "table")
    if name.startswith("scene-") and name != "scene-frame" and EXAMPLES <= 1000:
        return ("open brackets",)  # its YAML is read in one way
    return d.LONG_LINES if EXAMPLES > 1000 else d.LINES_OF[grammar]


@pytest.mark.parametrize(("name", "line"), [(name, line) for name in TEXT for line in worst_lines(name)])
def test_lines_of_ten_megabytes(good, name, line):
    """Before all else, and where a number in the middle stood."""
    whole = good(name).content
    middle = Damage(d.NUMBERS, 0.5, d.LONG_LINES[line])
    for content in (middle(whole), d.LONG_LINES[line] + b"\n" + whole):
        found = outcome(good(name), content)
        assert isinstance(found, str) or not differing(found, good(name).says)


@pytest.mark.parametrize("name", CASES)
def test_no_file_a_folder_an_empty_one_and_one_that_cannot_be_read(good, name):
    this = good(name)
    assert isinstance(outcome(this, b""), str) or name.startswith("config")
    this.path.unlink()
    try:
        assert_refused(this)
        this.path.mkdir()
        assert_refused(this)
        this.path.rmdir()
        # Whoever asks, and root too, gets an input/output error.
        this.path.symlink_to("/proc/self/mem")
        assert_refused(this)
    finally:
        if this.path.is_symlink():
            this.path.unlink()
        this.path.write_bytes(this.content)


def assert_refused(this: Good) -> None:
    with pytest.raises(ZlocusError) as caught:
        this.case.read(this.path)
    check_sentence(str(caught.value), this.path)


@pytest.mark.parametrize("laugh", ["lists", "merged", "itself"])
@pytest.mark.parametrize(
    ("name", "key"), [("scene-frame", "views"), ("config-yaml", "orientation"), ("eo-interior", "focal")]
)
def test_yaml_that_grows(good, name, key, laugh):
    assert isinstance(outcome(good(name), d.yaml_laughs(key)[laugh].encode()), str)


VIEW = b"{name: a, image: a.tif, camera: {kind: rpc}}"
# Scene files that are too much, by what there is too much of.
TOO_MUCH = {
    "a million views": b"views:\n" + (b"- " + VIEW + b"\n") * 10**6,
    "a million views in a line": b"views: [" + b"{}, " * 10**6 + b"{}]\n",
    "a million aliases": b"first: &a " + VIEW + b"\nviews:\n" + b"- *a\n" * 10**6,
    "lists in lists": b"views: " + b"[" * 1000 + b"]" * 1000 + b"\n",
    "keys in keys": b"views: " + b"{a: " * 10**5 + b"1" + b"}" * 10**5 + b"\n",
    "lines in lines": b"views:\n" + b"".join(b" " * n + b"a:\n" for n in range(1, 2000)),
}


@pytest.mark.parametrize("what", TOO_MUCH)
def test_a_scene_of_too_much(good, what):
    said = outcome(good("scene-frame"), b"schema: 1\n" + TOO_MUCH[what])
    assert ("holds more than 500000 values" if "million" in what else "nested more than 32 levels deep") in said


@pytest.mark.parametrize("laugh", ["inside", "outside"])
@pytest.mark.parametrize("name", ["metashape", "dimap-2", "dimap-3", "dimap-dim"])
def test_xml_with_entities(good, name, laugh):
    text = d.xml_laughs(good(name).content.decode())[laugh]
    assert "declares a document type" in str(outcome(good(name), text.encode()))


@each_text
@pytest.mark.parametrize("change", ["crlf", "utf-8-sig"])
def test_windows_line_ends_and_byte_order_marks_are_read(good, name, change):
    assert outcome(good(name), Damage(d.ENCODING, 0.0, change)(good(name).content)) == good(name).says


@each_text
def test_every_number_that_is_not_one(good, name):
    """NaN in the place of each number in turn is found, or stands where no camera is."""
    whole = good(name).content
    for match in list(re.finditer(rb"(?<![\w.])-?\d+\.\d+(?![\w.])", whole))[:MAX_NUMBERS]:
        found = outcome(good(name), whole[: match.start()] + b"nan" + whole[match.end() :])
        assert isinstance(found, str) or found == good(name).says, match


@pytest.mark.parametrize("count", [2**64 - 1, 2**40, 10**6])
@pytest.mark.parametrize("at", ["cameras", "images", "points"])
def test_counts_of_colmap_are_not_believed(good, at, count):
    """A field that counts takes no memory before the bytes are known to be there."""
    this = good("colmap-binary-cameras" if at == "cameras" else "colmap-binary-images")
    place = 0 if at != "points" else 8 + 64 + len(NAMES[0]) + 1
    content = this.content[:place] + struct.pack("<Q", count) + this.content[place + 8 :]
    assert "truncated or damaged" in outcome(this, content)


def test_numbers_of_colmap_that_would_overflow(good):
    content = good("colmap-binary-images").content
    assert "not a finite number" in outcome(
        good("colmap-binary-images"), content[:12] + struct.pack("<d", 1e300) + content[20:]
    )


@pytest.mark.parametrize("name", ["colmap-binary-cameras", "colmap-binary-images"])
def test_bytes_too_many(good, name):
    assert "1 bytes too many" in outcome(good(name), good(name).content + b"\0")


@pytest.mark.parametrize("name", ["image-tiff", "image-deflate", "dem"])
@pytest.mark.parametrize("size", [(2**31 - 1, 2**31 - 1), (2**20, 2**20), (80, 2**30)])
def test_sizes_of_tiff_are_not_believed(good, name, size):
    """Columns and rows stand in the first two entries of its directory. Source: TIFF 6.0, section 2."""
    content = bytearray(good(name).content)
    start = struct.unpack_from("<I", content, 4)[0] + 2
    for entry, (tag, value) in enumerate(zip((256, 257), size, strict=True)):
        assert struct.unpack_from("<H", content, start + 12 * entry)[0] == tag
        struct.pack_into("<HHII", content, start + 12 * entry, tag, 4, 1, value)
    assert isinstance(outcome(good(name), bytes(content)), str)


# What was found in the readers, and mended: a piece of a file, and what stood there instead.
FOUND = [
    ("rpc-txt", b"LINE_OFF: +19500.25", b"LINE_OFF: +1_9500.25"),
    ("rpc-txt", b"LINE_OFF: +19500.25", b"LINE_OFF: +195 00.25"),
    ("rpc-txt", b"LAT_OFF:", b"LAT_OFF: 1\nLAT_OFF:"),
    ("rpc-txt", b"LAT_SCALE: +0", b"LAT_SCALE: 1e-320\nOLD: 0"),
    ("rpb", b"lineOffset = ", b"lineOffset = 1_"),
    ("rpb", b"lineOffset = ", b"lineOffset = 5;\nlineOffset = "),
    ("dimap-2", b"<LAT_OFF>", b"<LAT_OFF>1.0</LAT_OFF><LAT_OFF>"),
    ("dimap-3", b"<FIRST_ROW>0.5", b"<FIRST_ROW>nan"),
    ("dimap-3", b"<FIRST_COL>0.5", b"<FIRST_COL>first"),
    ("dimap-dim", b'nrows="500"', b'nrows="0.5"'),
    ("dimap-dim", b'ncols="400"', b""),
    ("dimap-dim", b'tile_C="3"', b'tile_C="nan"'),
    ("dimap-dim", b'OVERLAP_ROW unit="pixel">0', b'OVERLAP_ROW unit="pixel">no'),
    ("scene-frame", b"1450.75", b"1_0"),
    ("scene-frame", b"1450.75", b"yes"),
    ("scene-frame", b"1450.75", b"true"),
    ("scene-frame", b"1450.75", b"12:30"),
    ("scene-frame", b"1450.75", b"0x1F"),
    ("scene-frame", b"earth: curved", b"earth:"),
    ("scene-frame", b"earth: curved", b"earth: curved\n    earth: flat"),
    ("scene-frame", b"EPSG:32631", b"IAU_2015:30110"),
    ("scene-local", b"70.5", b"1e-320"),
    ("scene-rpc", b"image: a.tif", b"image: " + b"a" * 5000),
    ("scene-linescan", b"- 0.5\n      - 0.0", b"- 1e-320\n      - 0.0"),
    ("scene-linescan", b"rows: 48", b"rows: 48\n      height: 9.0"),
    ("trajectory", b"-1.0,700100.5", "-1.0,٣".encode()),
    ("trajectory", b"-1.0,700100.5", b"-1.0,1e300"),
    ("csm", b'"m_nLines": 400', b'"m_nLines": 1000000000000'),
    ("csm", b'"m_nSamples": 300', b'"m_nSamples": 1000000000000'),
    ("csm", b'"m_nLines": 400', b'"m_nLines": 300, "m_nLines": 400'),
    ("csm", b'"m_platformFlag": 1', b'"m_platformFlag": true'),
    ("config-yaml", b"min_cells: 60", b"min_cells: 12:30"),
    ("config-toml", b"min_cells = 60", b"min_cells = 60\nmin_cells = 6"),
    ("colmap-text-cameras", b"70.0", "١٢".encode()),
    ("metashape", b"6378137", b"1.0"),
    ("metashape", b"0.0174532925199433", b"0.0"),
    ("opensfm", b'"width"', b'"width": 64, "width"'),
    ("eo", b"b 30.0", b"b 1 30.0"),
    ("area-geojson", b"[ 700110.0, 4790210.0 ], ", b""),
    ("area-geojson", b'"name": "area"', b'"name": "\x80"'),
]


@pytest.mark.parametrize(("name", "old", "new"), FOUND)
def test_what_was_found(good, name, old, new):
    whole = good(name).content
    assert old in whole
    assert isinstance(outcome(good(name), whole.replace(old, new, 1)), str)


@pytest.mark.parametrize(
    ("name", "end"),
    [
        ("rpc-txt", b"1.5235"), ("scene-frame", b"curved"), ("scene-frame", b"EPSG:3263"), ("config-toml", b"0."),
        ("config-yaml", b"0."), ("control", b"view1,51"), ("times", b"6"), ("calibration", b"-9"), ("image-png", b""),
    ],
)  # fmt: skip
def test_truncated_within_the_last_value(good, name, end):
    whole = good(name).content
    at = whole.rindex(end) + len(end) if end else len(whole) // 2
    assert "truncated" in outcome(good(name), whole[:at])
