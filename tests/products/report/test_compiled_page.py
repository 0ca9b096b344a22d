"""The compiled template of the report is kept and used again, and nothing fails where it cannot be."""

from __future__ import annotations

import pytest
from jinja2 import DictLoader, Environment

from zlocus.products.report.compiled_page import CompiledPages


def page(folder, text="Height {{ height }} m"):
    """A template, rendered by an environment of its own."""
    environment = Environment(loader=DictLoader({"page": text}), bytecode_cache=CompiledPages(folder))
    return environment.get_template("page").render(height=12)


@pytest.fixture
def compiled(monkeypatch):
    """The templates that are compiled."""
    compiled, compile_ = [], Environment.compile
    monkeypatch.setattr(Environment, "compile", lambda *given, **named: compiled.append(1) or compile_(*given, **named))
    return compiled


def test_a_template_is_compiled_once(tmp_path, compiled):
    assert [page(tmp_path / "kept") for _ in range(3)] == ["Height 12 m"] * 3
    assert len(compiled) == 1
    assert len(list((tmp_path / "kept").iterdir())) == 1


def test_another_template_is_compiled_anew(tmp_path, compiled):
    assert page(tmp_path) == "Height 12 m"
    assert page(tmp_path, "{{ height }}") == "12"
    assert len(compiled) == 2


@pytest.mark.parametrize("content", [b"", b"no template", b"j2\x80\x02K\x05.\x80\x02J\x0b\x00\x00\x03.cut"])
def test_a_damaged_file_is_replaced(tmp_path, compiled, content):
    page(tmp_path)
    (kept,) = tmp_path.iterdir()
    whole = kept.read_bytes()
    kept.write_bytes(content)
    assert page(tmp_path) == "Height 12 m"
    assert len(compiled) == 2
    assert kept.read_bytes() == whole


def test_where_nothing_can_be_written(tmp_path, compiled):
    (tmp_path / "file").touch()
    assert [page(tmp_path / "file" / "folder") for _ in range(2)] == ["Height 12 m"] * 2
    assert len(compiled) == 2
