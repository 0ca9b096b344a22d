"""Damaged files of every format: one sentence or the right cameras, never a crash, a hang or a wrong camera."""

from __future__ import annotations

import resource
import struct
import time

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import camera_files as files
from zlocus.errors import ZlocusError
from zlocus.io.importers.scene import import_scene
from zlocus.request import ImportRequest

CASES = {
    "colmap-text-cameras": ("colmap", files.write_colmap, "sparse/0/cameras.txt"),
    "colmap-text-images": ("colmap", files.write_colmap, "sparse/0/images.txt"),
    "colmap-binary-cameras": ("colmap", lambda f: files.write_colmap(f, binary=True), "sparse/0/cameras.bin"),
    "colmap-binary-images": ("colmap", lambda f: files.write_colmap(f, binary=True), "sparse/0/images.bin"),
    "opensfm": ("opensfm", files.write_opensfm, "reconstruction.json"),
    "metashape": ("metashape", files.write_metashape, "cameras.xml"),
    "bundler": ("bundler", files.write_bundler, "bundle.out"),
    "bundler-list": ("bundler", files.write_bundler, "list.txt"),
    "eo": ("eo", files.write_eo, "eo.csv"),
    "eo-interior": ("eo", files.write_eo, "camera.yaml"),
    "strecha": ("strecha", files.write_strecha, "b.tif.camera"),
}
TEXT = [name for name in CASES if "binary" not in name]
WORDS = [
    b"nan",
    b"inf",
    b"-1",
    b"0",
    b"1e999",
    b"1_0",
    b"9" * 400,
    b"\xff\xfe",
    b"\0",
    b" ",
    b"\n",
    b'"',
    b"{",
    b"<",
    b"&",
]
SECONDS, MEGABYTES = 5.0, 300


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A good folder per case, with what it holds and what it becomes."""
    made = {}

    def of(name):
        if name not in made:
            kind, write, file = CASES[name]
            folder = write(tmp_path_factory.mktemp(name) / "p").folder
            path = folder / file
            made[name] = (kind, folder, path, path.read_bytes(), attempt(kind, folder))
            assert not isinstance(made[name][-1], str)
        return made[name]

    return of


def attempt(kind, folder):
    """The views, or what was said."""
    options = {"camera": folder / "camera.yaml"} if kind == "eo" else {}
    out = folder / "scene.yaml"
    try:
        return import_scene(ImportRequest(kind, folder, out, overwrite=True, **options)).views
    except ZlocusError as error:
        return str(error)


def of_damaged(folders, name, damage):
    kind, folder, path, content, good = folders(name)
    damaged = damage(content)
    path.write_bytes(damaged)
    try:
        found = attempt(kind, folder)
    finally:
        path.write_bytes(content)
    if isinstance(found, str):
        assert "\n" not in found
        assert found[-1] in ".?"
        assert len(found) < 1500
    return found, good


each = pytest.mark.parametrize("name", CASES)
quick = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)


@pytest.mark.parametrize("name", [name for name in CASES if name != "eo-interior"])  # a hand-written file has no end
@quick
@given(share=st.floats(0.0, 1.0, exclude_max=True))
def test_truncated_anywhere(folders, name, share):
    """Whole lines of a table that says nothing of its length may be missing."""
    found, good = of_damaged(folders, name, lambda content: content[: int(len(content) * share)])
    assert isinstance(found, str) or found == good or (name == "eo" and found == good[: len(found)])


@each
@quick
@given(share=st.floats(0.0, 1.0), word=st.sampled_from(WORDS), cut=st.integers(0, 12))
def test_something_else_in_its_place(folders, name, share, word, cut):
    def damage(content):
        at = int(len(content) * share)
        return content[:at] + word + content[at + cut :]

    found, _ = of_damaged(folders, name, damage)
    if not isinstance(found, str):
        numbers = [v for view in found for v in (*view.camera.centre, *np.ravel(view.camera.rotation))]
        assert np.isfinite(numbers).all()


@each
@quick
@given(content=st.binary(max_size=300))
def test_anything_at_all(folders, name, content):
    assert isinstance(of_damaged(folders, name, lambda _: content)[0], str)


@pytest.mark.parametrize("name", TEXT)
def test_every_number_that_is_not_one(folders, name):
    """NaN in the place of each number in turn is found, or stands where no camera is."""
    import re

    _, _, _, content, good = folders(name)
    for match in re.finditer(rb"(?<![\w.])-?\d+\.\d+(?![\w.])", content):
        found, _ = of_damaged(folders, name, lambda c, m=match: c[: m.start()] + b"nan" + c[m.end() :])
        assert isinstance(found, str) or found == good


@pytest.mark.parametrize("name", TEXT)
@pytest.mark.parametrize("line", [b"1 " * 2_000_000, b"x" * 4_000_000, b"[" * 1_000_000, b"<a>" * 300_000])
def test_very_long_lines(folders, name, line):
    started = time.monotonic()
    found, _ = of_damaged(folders, name, lambda content: line + b"\n" + content)
    assert isinstance(found, str)
    assert time.monotonic() - started < SECONDS


@pytest.mark.parametrize("name", TEXT)
@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_other_encodings(folders, name, encoding):
    assert isinstance(of_damaged(folders, name, lambda c: ("é" + c.decode()).encode(encoding))[0], str)


@pytest.mark.parametrize("name", TEXT)
def test_windows_line_ends_and_byte_order_marks_are_read(folders, name):
    if name == "metashape":
        return  # as ever in XML
    found, good = of_damaged(folders, name, lambda c: b"\xef\xbb\xbf" + c.replace(b"\n", b"\r\n"))
    assert found == good


@pytest.mark.parametrize("count", [2**64 - 1, 2**40, 10**6])
@pytest.mark.parametrize("at", ["cameras", "images", "points"])
def test_counts_are_not_believed(folders, at, count):
    """A field that counts takes no memory before the bytes are known to be there."""
    name = "colmap-binary-cameras" if at == "cameras" else "colmap-binary-images"
    place = 0 if at != "points" else 8 + 64 + len(files.NAMES[0]) + 1
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    started = time.monotonic()
    found, _ = of_damaged(folders, name, lambda c: c[:place] + struct.pack("<Q", count) + c[place + 8 :])
    assert "truncated or damaged" in found
    assert time.monotonic() - started < SECONDS
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024 < MEGABYTES


@pytest.mark.parametrize("name", [name for name in CASES if "binary" in name])
def test_bytes_too_many(folders, name):
    assert "1 bytes too many" in of_damaged(folders, name, lambda content: content + b"\0")[0]


@pytest.mark.parametrize("opening", ["<!DOCTYPE a [", '<?xml version="1.0"?>\n<!DOCTYPE document [\n'])
def test_entities_are_refused(folders, opening):
    laughs = '<!ENTITY a0 "ha">' + "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))
    document = f"{opening}{laughs}]><document><chunk label='&a11;'/></document>"
    found, _ = of_damaged(folders, "metashape", lambda _: document.encode())
    assert "declares a document type" in found
    outside = "<!DOCTYPE d [<!ENTITY e SYSTEM 'file:///etc/passwd'>]><document><chunk label='x'>&e;</chunk></document>"
    assert "declares a document type" in of_damaged(folders, "metashape", lambda _: outside.encode())[0]


def test_values_that_hold_themselves_many_times_over(folders):
    laughs = "&a0 [1, 1]" + "".join(f", &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12))
    for text in (f"focal: [{laughs}]", f"lol: [{laughs}]\nfocal: *a11\n", "focal: &f [*f, *f]\n", "focal: [" * 3000):
        found, _ = of_damaged(folders, "eo-interior", lambda _, t=text: t.encode())
        assert isinstance(found, str)
