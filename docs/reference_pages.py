"""Parts of the documentation that are made from the code, as Markdown: commands, options, and pages of no list."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import Field, fields, is_dataclass
from pathlib import Path
from typing import Any

import typer.main

from zlocus.cli.app import app
from zlocus.core.options import RunConfig

# What begins a sentence that is of no single parameter, though it stands behind one.
OF_ALL = re.compile(r"(?<=\.) (?=(?:Returns|Source:|Heights come back) )")
# Pages on what comes out, in their order, where they are there.
RESULTS = ("products", "vertical", "evaluate", "report", "inspect")


def command_reference() -> str:
    """Every command of `zlocus`: what it does, its arguments and options, in the order in which they are defined."""
    # Typer has its own copy of Click, whose names are private: what is used of it is looked at, not typed.
    commands: dict[str, Any] = vars(typer.main.get_command(app))["commands"]
    return "\n\n".join(_command(name, command) for name, command in commands.items())


def _command(name: str, command: Any) -> str:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    needed = [f"{_names(p)} {_metavar(p)}" for p in command.params if p.required and p not in arguments]
    shown = [f"{p.metavar}{'...' if p.nargs < 0 else ''}" for p in arguments]
    usage = " ".join(["zlocus", name, *shown, *(each.replace("-o, --out", "-o") for each in needed), "[OPTIONS]"])
    lines = [f"## zlocus {name}", "", " ".join(command.help.split()), "", f"`{usage}`", "", "| | says | default |"]
    return "\n".join([*lines, "|---|---|---|", *map(_parameter, command.params)])


def _parameter(parameter: Any) -> str:
    default = "must be given" if parameter.required else _default(parameter.default)
    if parameter.secondary_opts:
        default = f"`{(parameter.opts if parameter.default else parameter.secondary_opts)[0]}`"
    name = parameter.metavar if parameter.param_type_name == "argument" else _names(parameter)
    words = name if name == parameter.metavar else f"{name} {_metavar(parameter)}".rstrip()
    return f"| `{_cell(words)}` | {_cell(parameter.help)} | {default} |"


def _names(parameter: Any) -> str:
    """All forms of an option, those that say the contrary last."""
    return ", ".join([*parameter.opts, *parameter.secondary_opts])


def _metavar(parameter: Any) -> str:
    return "" if getattr(parameter, "is_flag", False) else parameter.metavar or parameter.name.upper()


def _default(value: Any) -> str:
    return "" if value is None or value is False else f"`{value}`"


def option_reference() -> str:
    """Every option of every stage: name, default, limits and unit, and its sentence."""
    return "\n".join(_stage(RunConfig(), "", ""))


def _stage(options: Any, prefix: str, doc: str) -> Iterator[str]:
    stages = [f for f in fields(options) if is_dataclass(getattr(options, f.name))]
    own = [f for f in fields(options) if f not in stages]
    if own:
        yield from ("", f"## `[{prefix.rstrip('.')}]`", "", doc, "", "| option | default | allowed | says |")
        yield "|---|---|---|---|"
        yield from (_option(f, getattr(options, f.name)) for f in own)
    for f in stages:
        yield from _stage(getattr(options, f.name), f"{prefix}{f.name}.", f.metadata["doc"])


def _option(f: Field[Any], value: Any) -> str:
    unit = f" {f.metadata['unit']}" if f.metadata["unit"] else ""
    default = "unset" if value is None else f"{value}{unit}"
    return f"| `{f.name}` | {default} | {_limits(f)}{unit} | {_cell(f.metadata['doc'])} |"


def _limits(f: Field[Any]) -> str:
    low, high, choices = (f.metadata[key] for key in ("low", "high", "choices"))
    if choices is not None:
        return ", ".join(map(str, choices))
    if None not in (low, high):
        return f"{low:g} to {high:g}"
    return "" if low is high else f"at least {low:g}" if high is None else f"at most {high:g}"


def _cell(text: str) -> str:
    """Text that may stand in a cell of a table."""
    return " ".join(text.split()).replace("|", "\\|")


def result_pages(folder: Path) -> str:
    """Names of the pages on results that are there, a line each."""
    return "\n".join(name for name in RESULTS if (folder / f"{name}.md").exists())


def unlisted_pages(folder: Path) -> str:
    """Names of the pages in a folder that its index does not list, a line each: none is without a place."""
    listed = set(re.findall(r"^([a-z_]+)$", (folder / "index.md").read_text(encoding="utf-8"), re.MULTILINE))
    return "\n".join(sorted({page.stem for page in folder.glob("*.md")} - listed - {"index", *RESULTS}))


def with_listed_parameters(lines: list[str], names: Iterable[str]) -> list[str]:
    """The lines of a docstring with its parameters as a list, behind its sentences and before what it raises.

    Docstrings say `name : what it is`, also of several names with commas between, and of several parameters in a
    paragraph, set apart by full stops or semicolons: that reads well in the code and runs together on a page. names :
    of the parameters, or of the fields of a class.
    """
    name = "|".join(sorted(map(re.escape, names), key=len, reverse=True))
    if not name:
        return lines
    begin = re.compile(rf"(?:^|(?<=[.;]) )((?:{name})(?:, (?:{name}))*) ?: ")
    sentences, listed, rest = list[str](), list[str](), list[str]()
    for paragraph in re.split(r"\n\s*\n", "\n".join(lines).strip("\n")):
        if rest or paragraph.startswith((":", "..")):
            rest.append(paragraph)
            continue
        first, *parts = begin.split(" ".join(paragraph.split()))
        sentences.append(first if parts else paragraph)
        for of, said in zip(parts[::2], parts[1::2], strict=True):
            text, *others = OF_ALL.split(said, maxsplit=1)
            # Sphinx takes a word before a name for its type.
            listed.append(f":param {of.replace(', ', ',')}: {text.removesuffix(';')}")
            sentences += others
    parts = [*filter(str.strip, sentences), "\n".join(listed), *rest]
    return [*"\n\n".join(filter(None, parts)).splitlines(), ""]
