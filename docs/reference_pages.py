"""Parts of the reference pages that are made from the code, as Markdown: all commands, all options, parameter lists."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import Field, fields, is_dataclass
from typing import Any

import typer.main

from zlocus.cli.app import app
from zlocus.core.options import RunConfig

# The beginning of a sentence that follows a parameter's description and belongs to the whole function.
OF_ALL = re.compile(r"(?<=\.) (?=(?:Returns|Source:|Heights come back) )")


def all_commands() -> dict[str, Any]:
    """The commands of `zlocus` by their names, in the order of their definition; those of a group as `tiles plan`."""
    # Typer ships its own copy of Click, whose classes are private: hence `Any`.
    commands: dict[str, Any] = {}
    for name, command in vars(typer.main.get_command(app))["commands"].items():
        of_group = vars(command).get("commands", {})
        commands |= {f"{name} {each}": of_group[each] for each in of_group} or {name: command}
    return commands


def command_reference() -> str:
    """Section for each command of `zlocus`: its purpose, arguments and options, in the order of their definition."""
    return "\n\n".join(_command(name, command) for name, command in all_commands().items())


def _command(name: str, command: Any) -> str:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    required = [f"{_names(p)} {_metavar(p)}" for p in command.params if p.required and p not in arguments]
    shown = [_shown(p) for p in arguments]
    usage = " ".join(["zlocus", name, *shown, *(each.replace("-o, --out", "-o") for each in required), "[OPTIONS]"])
    lines = [f"## zlocus {name}", "", " ".join(command.help.split()), "", f"`{usage}`", "", "| | meaning | default |"]
    return "\n".join([*lines, "|---|---|---|", *map(_parameter, command.params)])


def _shown(argument: Any) -> str:
    words = f"{argument.metavar}{'...' if argument.nargs < 0 else ''}"
    return words if argument.required else f"[{words}]"


def _parameter(parameter: Any) -> str:
    default = "required" if parameter.required else _default(parameter.default)
    if parameter.secondary_opts:
        default = f"`{(parameter.opts if parameter.default else parameter.secondary_opts)[0]}`"
    name = parameter.metavar if parameter.param_type_name == "argument" else _names(parameter)
    words = name if name == parameter.metavar else f"{name} {_metavar(parameter)}".rstrip()
    return f"| `{_cell(words)}` | {_cell(parameter.help)} | {default} |"


def _names(parameter: Any) -> str:
    """All names of an option; those that switch it off come last."""
    return ", ".join([*parameter.opts, *parameter.secondary_opts])


def _metavar(parameter: Any) -> str:
    return "" if getattr(parameter, "is_flag", False) else parameter.metavar or parameter.name.upper()


def _default(value: Any) -> str:
    return "" if value is None or value is False else f"`{value}`"


def option_reference() -> str:
    """Section for each stage of the configuration: name, default, allowed range, unit and sentence of every option."""
    return "\n".join(_stage(RunConfig(), "", ""))


def _stage(options: Any, prefix: str, doc: str) -> Iterator[str]:
    stages = [f for f in fields(options) if is_dataclass(getattr(options, f.name))]
    own = [f for f in fields(options) if f not in stages]
    if own:
        yield from ("", f"## `[{prefix.rstrip('.')}]`", "", doc, "", "| option | default | allowed | meaning |")
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
    """Text with line breaks removed and vertical bars escaped, for a cell of a table."""
    return " ".join(text.split()).replace("|", "\\|")


def with_listed_parameters(lines: list[str], names: Iterable[str]) -> list[str]:
    """Lines of a docstring with its parameters as a list, after its sentences and before the errors it raises.

    In the code, docstrings describe parameters in running text: `name : what it is`, several of them in a paragraph,
    separated by full stops or semicolons. That reads well in the code, but runs together on a page. names : names of
    the parameters, or of the fields of a class.
    """
    name = "|".join(sorted(map(re.escape, names), key=len, reverse=True))
    if not name:
        return lines
    begin = re.compile(rf"(?:^|(?<=[.;]) )((?:{name})(?:, (?:{name}))*) ?: ")
    sentences, parameters, rest = list[str](), list[str](), list[str]()
    for paragraph in re.split(r"\n\s*\n", "\n".join(lines).strip("\n")):
        if rest or paragraph.startswith((":", "..")):
            rest.append(paragraph)
            continue
        first, *parts = begin.split(" ".join(paragraph.split()))
        sentences.append(first if parts else paragraph)
        for of_names, description in zip(parts[::2], parts[1::2], strict=True):
            text, *others = OF_ALL.split(description, maxsplit=1)
            # No blank between names: Sphinx takes a word before the last name for its type.
            parameters.append(f":param {of_names.replace(', ', ',')}: {text.removesuffix(';')}")
            sentences += others
    parts = [*filter(str.strip, sentences), "\n".join(parameters), *rest]
    return [*"\n\n".join(filter(None, parts)).splitlines(), ""]
