"""Read text of groups and statements, as Maxar writes .IMD and .TIL: `BEGIN_GROUP = IMAGE_1`, `satId = "WV03";`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.io.safe_text import EXPORT_AGAIN, read_text

# A real file has a hundredth of this.
MAX_BYTES = 10_000_000
STATEMENT = re.compile(r"\s*(\w+)\s*=\s*(\([^()]*\)|\"[^\"]*\"|[^;\n]*?)\s*(?:;|\n|\Z)")
END = re.compile(r"\s*END\s*;?\s*\Z")


@dataclass
class StatementGroup:
    """Statements of a group, by their names in lower case, and the groups in it, in the order of the file.

    name : as it stands in the file, empty for the file itself.
    """

    name: str
    values: dict[str, str] = field(default_factory=dict)
    groups: list[StatementGroup] = field(default_factory=list)

    def text(self, name: str) -> str | None:
        """The value of a statement, without quotation marks; None where there is none."""
        return self.values.get(name.lower())

    def within(self, prefix: str) -> list[StatementGroup]:
        """The groups in this one whose names begin so, in any capital letters."""
        return [group for group in self.groups if group.name.lower().startswith(prefix.lower())]

    def all_groups(self) -> Iterator[StatementGroup]:
        """Yield this group and all groups in it, at any depth."""
        yield self
        for group in self.groups:
            yield from group.all_groups()


def read_groups(path: Path) -> StatementGroup:
    """The statements and groups of a file.

    Raises
    ------
    InputError
        The file is no such text, gives a name twice with different values, or ends within a group.
    """
    text = read_text(path, MAX_BYTES)
    open_groups, at = [StatementGroup("")], 0
    while END.match(text, at) is None and text[at:].strip():
        found = STATEMENT.match(text, at)
        if found is None:
            line = text.count("\n", 0, at + len(text[at:]) - len(text[at:].lstrip())) + 1
            raise InputError(f"{path}, line {line}, is no statement of a name and a value. {EXPORT_AGAIN}")
        at, name, value = found.end(), found[1], found[2].strip().strip('"')
        if name.upper() == "BEGIN_GROUP":
            group = StatementGroup(value)
            open_groups[-1].groups.append(group)
            open_groups.append(group)
        elif name.upper() == "END_GROUP":
            if len(open_groups) == 1 or open_groups[-1].name != value:
                raise InputError(f"{path} ends the group {quoted(value)}, which is not open there. {EXPORT_AGAIN}")
            open_groups.pop()
        elif open_groups[-1].values.setdefault(name.lower(), value) != value:
            raise InputError(f"{path} gives {quoted(name)} twice, with different values. {EXPORT_AGAIN}")
    if len(open_groups) > 1:
        raise InputError(f"{path} stops within the group {quoted(open_groups[-1].name)}. {EXPORT_AGAIN}")
    return open_groups[0]
