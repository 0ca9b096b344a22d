"""Ways to damage a file, the same for every format: strategies that draw a `Damage`, and long lines.

A strategy knows nothing of the file it will damage: places are shares of it, so that one draw fits all formats.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import pairwise

from hypothesis import strategies as st

# Where a number stood: not numbers, not the same in every reader's eyes, or far out.
WORDS = (
    "nan", "inf", "-inf", "1e999", "1e308", "-1", "0", "1e-320", "18446744073709551616", "9" * 400, "1_0", "true",
    "yes", "12:30", "0x1F", "010", "~", "null", "", "abc", "é", "١٢", "'", '"', "{", "[", "<", "&", "*", "!!int", "\0",
    "1,5", "1.5.2", "--3", "#", ";", ":",
)  # fmt: skip
TOKEN = re.compile(rb"[\w.+-]+")
NUMBER = re.compile(rb"(?<![\w.+-])[+-]?\d+(\.\d*)?([eE][+-]?\d+)?(?![\w.])")
CUT, LINES, TOKENS, NUMBERS, ENCODING, BYTES = "cut", "lines", "token", "number", "encoding", "bytes"
ENCODINGS = ("utf-16", "utf-16-le", "utf-32", "latin-1", "cp037", "utf-8-sig", "crlf", "cr", "nul", "trailing blanks")
# These change nothing that a reader may care about.
HARMLESS = ("utf-8-sig", "crlf", "trailing blanks")


@dataclass(frozen=True)
class Damage:
    """kind : of the above. share : where, of the file, in [0, 1). word : what is put there, or how lines or encoding
    change; count : bytes or lines concerned."""

    kind: str
    share: float
    word: str | bytes = ""
    count: int = 1

    def place(self, content: bytes) -> tuple[int, int]:
        """The bytes concerned: start and end."""
        if self.kind in (TOKENS, NUMBERS):
            found = [m.span() for m in (TOKEN if self.kind == TOKENS else NUMBER).finditer(content)]
            return found[int(self.share * len(found))] if found else (0, 0)
        start = int(self.share * (len(content) + (self.kind == BYTES)))
        return start, min(start + self.count, len(content))

    def __call__(self, content: bytes) -> bytes:
        """The damaged file."""
        start, end = self.place(content)
        if self.kind == CUT:
            return content[:start]
        if self.kind == LINES:
            return self._lines(content)
        if self.kind == ENCODING:
            return self._encoded(content)
        word = self.word if isinstance(self.word, bytes) else self.word.encode()
        return content[:start] + word + content[end:]

    def _lines(self, content: bytes) -> bytes:
        lines = content.splitlines(keepends=True)
        at = int(self.share * len(lines))
        chosen = lines[at : at + self.count]
        rest = [lines[:at], lines[at + self.count :]]
        if self.word == "deleted":
            chosen = []
        elif self.word == "doubled":
            chosen = chosen * 2
        else:
            chosen = chosen[::-1]
        return b"".join([*rest[0], *chosen, *rest[1]])

    def _encoded(self, content: bytes) -> bytes:
        if self.word == "crlf":
            return content.replace(b"\n", b"\r\n")
        if self.word == "cr":
            return content.replace(b"\n", b"\r")
        if self.word == "nul":
            at = int(self.share * len(content))
            return content[:at] + b"\0" * self.count + content[at:]
        if self.word == "trailing blanks":
            return content + b" \n\n" * self.count
        text = content.decode("utf-8")
        # Latin-1 shows only where letters are not ASCII.
        return (text if self.word != "latin-1" else "# é\n" + text).encode(str(self.word))


def _shares() -> st.SearchStrategy[float]:
    # The ends of a file are its tender places.
    return st.one_of(st.floats(0.0, 1.0, exclude_max=True), st.floats(0.97, 1.0, exclude_max=True), st.just(0.0))


def cuts() -> st.SearchStrategy[Damage]:
    """Truncated at any byte."""
    return st.builds(Damage, st.just(CUT), _shares())


def byte_edits() -> st.SearchStrategy[Damage]:
    """Some bytes replaced, put in or taken out."""
    large = [b"\xff" * 8, b"\0" * 8, b"\xff\xff\xff\x7f", (2**40).to_bytes(8, "little"), b"\0\0\0\0\0\0\xf8\x7f"]
    filler = st.one_of(st.binary(max_size=12), st.sampled_from(large))
    return st.builds(Damage, st.just(BYTES), _shares(), filler, st.integers(0, 12))


def number_edits() -> st.SearchStrategy[Damage]:
    """A number replaced by another one that is as good by itself."""
    numbers = st.one_of(st.floats(-1e7, 1e7).map(repr), st.integers(-10, 10**6).map(str))
    return st.builds(Damage, st.just(NUMBERS), _shares(), numbers)


def text_damage() -> st.SearchStrategy[Damage]:
    """All that can happen to a text file."""
    return st.one_of(
        cuts(),
        st.builds(
            Damage, st.just(LINES), _shares(), st.sampled_from(["deleted", "doubled", "turned"]), st.integers(1, 3)
        ),
        st.builds(Damage, st.sampled_from([TOKENS, NUMBERS]), _shares(), st.sampled_from(WORDS)),
        number_edits(),
        st.builds(Damage, st.just(ENCODING), _shares(), st.sampled_from(ENCODINGS), st.integers(1, 4)),
        byte_edits(),
    )


def binary_damage() -> st.SearchStrategy[Damage]:
    """All that can happen to any file."""
    return st.one_of(cuts(), byte_edits(), byte_edits())


LARGE = 10_000_000
# Lines of 10 MB, by name.
LONG_LINES = {
    "numbers": b"1 " * (LARGE // 2), "commas": b"1," * (LARGE // 2), "word": b"x" * LARGE, "digits": b"7" * LARGE,
    "blanks": b" " * LARGE, "open brackets": b"[" * LARGE, "open braces": b"{" * LARGE,
    "open parentheses": b"(" * LARGE, "keys": b"a: " * (LARGE // 3), "equal signs": b"a=" * (LARGE // 2),
    "assigned": b"a = (" * (LARGE // 5),
    "dashes": b"- " * (LARGE // 2), "elements": b"<a>" * (LARGE // 3), "empty elements": b"<a/>" * (LARGE // 4),
    "quotes": b'"' * LARGE, "aliases": b"*a " * (LARGE // 3), "comment": b"#" * LARGE, "nul": b"\0" * LARGE,
    "semicolons": b";" * LARGE, "list": b"[" + b"1, " * (LARGE // 3) + b"1]",
    "lists": b"[" + b"[1], " * (LARGE // 5) + b"1]", "json table": b"{" + b'"a": 1, ' * (LARGE // 8) + b'"b": 1}',
}  # fmt: skip
# By grammar, those it could choke on.
LINES_OF = {
    "json": ("open brackets", "lists", "json table"),
    # GDAL reads it, and takes 520 MB for the lists.
    "geojson": ("open brackets", "digits"),
    "xml": ("elements", "empty elements"),
    "yaml": ("open brackets", "dashes", "list", "digits"),
    "toml": ("open brackets", "list", "digits"),
    "rpb": ("word", "equal signs", "assigned", "open parentheses"),
    "table": ("numbers", "commas"),
}


def yaml_laughs(key: str) -> dict[str, str]:
    """Documents that grow a thousand million times when their aliases are followed, or that hold themselves."""
    names = "abcdefghij"
    lists = "".join(f", &{b} [{', '.join([f'*{a}'] * 10)}]" for a, b in pairwise(names))
    merged = "".join(f"{b}: &{b} {{<<: [{', '.join([f'*{a}'] * 10)}]}}\n" for a, b in pairwise(names))
    return {
        "lists": f"{key}: [&a [1, 1]{lists}]\n",
        "merged": f"a: &a {{k: 1}}\n{merged}{key}: *j\n",
        "itself": f"{key}: &a [*a, *a]\n",
    }


def xml_laughs(document: str) -> dict[str, str]:
    """A document that names entities: of itself, of another file."""
    inside = '<!ENTITY a0 "ha">' + "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))
    start = document.index("?>") + 2
    rest = document[start:].replace(">", ">&e;", 1)
    return {
        "inside": f"{document[:start]}<!DOCTYPE d [{inside}<!ENTITY e '&a11;'>]>{rest}",
        "outside": f"{document[:start]}<!DOCTYPE d [<!ENTITY e SYSTEM 'file:///etc/hostname'>]>{rest}",
    }
