"""`zlocus config`: a complete commented configuration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console
from zlocus.core.errors import OutputError


@dataclass(frozen=True)
class ConfigOptions:
    """Options of `zlocus config`."""

    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="File to write, in TOML. Without it, or with -, print.")
    ] = None


def config(options: ConfigOptions, console: Console) -> Answer:
    """Write a configuration with a comment for every option."""
    from zlocus.core.options import RunConfig
    from zlocus.io.atomic_write import atomic_file
    from zlocus.io.config import config_as_dict, write_config

    text, out, values = write_config(RunConfig()), options.out, {"options": config_as_dict(RunConfig())}
    if out is None or str(out) == "-":
        return Answer(text.rstrip("\n"), values, is_asked_for=True)
    if out.exists():
        raise OutputError(f"{out} exists already and may hold your settings. Choose another name with -o.")
    try:
        with atomic_file(out) as part:
            part.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{out} cannot be written: {error.strerror}. Choose another name with -o.") from error
    return Answer(f"{out}: every option with its default and a comment.", values)
