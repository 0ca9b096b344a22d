"""Safe reading of JSON, XML and YAML: nothing that could exhaust the memory, and nothing ambiguous."""

from __future__ import annotations

import gc
import json
import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

import yaml

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.io.safe_text import EXPORT_AGAIN, check_last_line_ended, read_bytes, read_text

MAX_XML_DEPTH = 64
MAX_YAML_DEPTH = 32
TOO_DEEP = f"{{path}} is nested more than {MAX_YAML_DEPTH} levels deep. Check its brackets."
MAX_YAML_BYTES = 64_000_000
# About as many as ten thousand cameras need. An alias counts as often as the values that it repeats.
MAX_VALUES = 500_000
# Numbers and truth values of YAML 1.1, but without other bases than 10, underscores, and yes and no as truth values.
BOOL, INT, FLOAT = (f"tag:yaml.org,2002:{kind}" for kind in ("bool", "int", "float"))
PLAIN_SCALARS: dict[str, tuple[str, str]] = {
    BOOL: (r"true|True|TRUE|false|False|FALSE", "tTfF"),
    INT: (r"[-+]?(?:0|[1-9][0-9]*)", "-+0123456789"),
    FLOAT: (r"[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+][0-9]+)?|[-+]?\.(?:inf|nan)", "-+0123456789."),
}


def read_json(path: Path, start: str | None = None, advice: str = EXPORT_AGAIN) -> Any:
    """The content of a JSON file whose numbers are finite and whose keys are unique.

    start : first character of the document, before which any other text is ignored. advice : last sentence of messages.

    Raises
    ------
    InputError
        The file is not such a document.
    """

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"it holds {constant}, which is no number")

    def number(text: str) -> float:
        return float(text) if math.isfinite(float(text)) else refuse(text)

    def table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        mapping = dict(pairs)
        if len(mapping) < len(pairs):
            keys = [key for key, _ in pairs]
            raise ValueError(f"it holds {quoted(next(key for key in keys if keys.count(key) > 1))} twice in one place")
        return mapping

    text = read_text(path)
    if start is not None:
        text = text[max(text.find(start), 0) :]
    try:
        with _search_for_garbage_paused():
            return json.loads(text, parse_constant=refuse, parse_float=number, object_pairs_hook=table)
    except (ValueError, RecursionError) as error:
        what = "it is nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise InputError(f"{path} cannot be read as JSON: {what}. {advice}") from error


@contextmanager
def _search_for_garbage_paused() -> Iterator[None]:
    """Pause Python's search for cyclic garbage.

    A parser makes none, but every list that it makes brings the next search nearer. For a document of two million lists
    the searches took two thirds of the time.
    """
    searched = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if searched:
            gc.enable()


def read_xml(path: Path) -> Element:
    """The root element of an XML file without a document type, and so without entities.

    Raises
    ------
    InputError
        The file declares a document type, is nested too deeply, or is not XML.
    """
    content, depth, n_elements = read_bytes(path), 0, 0

    def refuse(*_: Any) -> NoReturn:
        raise InputError(
            f"{path} declares a document type, which camera files do not and which is not read. {EXPORT_AGAIN}"
        )

    def deeper(*_: Any) -> None:
        nonlocal depth, n_elements
        depth, n_elements = depth + 1, n_elements + 1
        if n_elements > MAX_VALUES:
            raise InputError(f"{path} holds more than {MAX_VALUES} elements. Check that it is the right file.")
        if depth > MAX_XML_DEPTH:
            raise InputError(
                f"{path} is nested more than {MAX_XML_DEPTH} levels deep: no file of cameras. {EXPORT_AGAIN}"
            )

    def higher(*_: Any) -> None:
        nonlocal depth
        depth -= 1

    check = expat.ParserCreate()
    check.StartDoctypeDeclHandler, check.StartElementHandler, check.EndElementHandler = refuse, deeper, higher
    try:
        check.Parse(content, True)
        return ElementTree.fromstring(content)
    except (expat.ExpatError, ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path} cannot be read as XML: {error}. {EXPORT_AGAIN}") from error


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """YAML in which only plain decimal numbers are numbers (see `PLAIN_SCALARS`)."""

    yaml_implicit_resolvers = {  # noqa: RUF012 (PyYAML's own way)
        first: [(tag, pattern) for tag, pattern in known if tag not in PLAIN_SCALARS]
        for first, known in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


for _tag, (_pattern, _first) in PLAIN_SCALARS.items():
    _Loader.add_implicit_resolver(_tag, re.compile(rf"(?:{_pattern})\Z"), list(_first))


def read_yaml(path: Path, max_bytes: int = MAX_YAML_BYTES) -> Any:
    """The content of a YAML file: YAML 1.1 with plain numbers only (see `PLAIN_SCALARS`), no tags, and unique keys.

    Raises
    ------
    InputError
        The file is not YAML, stops within a value, holds a key twice, or is larger than any file of options.
    """
    text = read_text(path, max_bytes)
    try:
        _YamlChecker(path).check(text)
        check_last_line_ended(text.rstrip(" \t"), path)
        return yaml.load(text, _Loader)
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        if "nesting depth" in str(error):
            # libyaml reads ahead and may reach its own limit first.
            raise InputError(TOO_DEEP.format(path=path)) from error
        raise InputError(f"{path} cannot be read as YAML: {' '.join(str(error).split())}. Mend it there.") from error


class _YamlChecker:
    """Checks a YAML document before any of its values is built."""

    def __init__(self, path: Path) -> None:
        self.path = path
        # For each open collection: its anchor, the number of values before it, and for a mapping its keys.
        self.open: list[tuple[str | None, int, set[str] | None]] = []
        self.is_key: list[bool] = []
        self.n_values = 0
        self.sizes: dict[str, int] = {}

    def check(self, text: str) -> None:
        """Raise `InputError` for anything that `read_yaml` refuses."""
        # Looked up by the type of the event, because a large document has a million of them.
        take: dict[type, Callable[[Any], None]] = {
            yaml.MappingStartEvent: self._begin_mapping,
            yaml.SequenceStartEvent: self._begin_sequence,
            yaml.MappingEndEvent: self._end,
            yaml.SequenceEndEvent: self._end,
            yaml.ScalarEvent: self._scalar,
            yaml.AliasEvent: self._alias,
        }
        for event in yaml.parse(text, _Loader):
            taken = take.get(type(event))
            if taken is not None:
                taken(event)

    def _begin_mapping(self, event: yaml.MappingStartEvent) -> None:
        self._begin(event, set())

    def _begin_sequence(self, event: yaml.SequenceStartEvent) -> None:
        self._begin(event, None)

    def _begin(self, event: yaml.CollectionStartEvent, keys: set[str] | None) -> None:
        self._value(event)
        if len(self.open) == MAX_YAML_DEPTH:
            raise InputError(TOO_DEEP.format(path=self.path))
        if event.anchor is not None:
            self.sizes.pop(event.anchor, None)
        self.open.append((event.anchor, self.n_values - 1, keys))
        self.is_key.append(True)

    def _end(self, _: yaml.CollectionEndEvent) -> None:
        anchor, before, _keys = self.open.pop()
        self.is_key.pop()
        if anchor is not None:
            self.sizes[anchor] = self.n_values - before

    def _scalar(self, event: yaml.ScalarEvent) -> None:
        self._value(event)
        if event.anchor is not None:
            self.sizes[event.anchor] = 1

    def _alias(self, event: yaml.AliasEvent) -> None:
        self._key(event)
        self._add(self._size(event.anchor or ""))

    def _value(self, event: yaml.ScalarEvent | yaml.CollectionStartEvent) -> None:
        """Check a scalar, or the beginning of a collection, which counts as one value."""
        if event.tag is not None:
            raise InputError(f"{self.path} holds the tag {quoted(event.tag)}, which is not read. Leave it out.")
        self._key(event)
        self._add(1)

    def _key(self, event: yaml.NodeEvent) -> None:
        """Check that keys are unique: in a mapping, every second value is a key."""
        keys = self.open[-1][2] if self.open else None
        if keys is None:
            return
        if self.is_key[-1] and isinstance(event, yaml.ScalarEvent):
            if event.value in keys:
                line = "" if event.start_mark is None else f", line {event.start_mark.line + 1}"
                raise InputError(f"{self.path}{line}: the key {quoted(event.value)} is there twice. Remove one.")
            keys.add(event.value)
        self.is_key[-1] = not self.is_key[-1]

    def _size(self, anchor: str) -> int:
        if anchor not in self.sizes:
            raise InputError(
                f"{self.path} refers to {quoted('*' + anchor)}, which is not complete there. Write it out."
            )
        return self.sizes[anchor]

    def _add(self, size: int) -> None:
        self.n_values += size
        if self.n_values > MAX_VALUES:
            raise InputError(f"{self.path} holds more than {MAX_VALUES} values. Check that it is the right file.")
